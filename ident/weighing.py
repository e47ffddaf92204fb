"""Weigh the body on the flange with a calibration: mass, centre and inertia, each with its σ.

With the gains g held, the ten parameters p of the body (paper §2.4) are the least-squares solution
of the motors' equations, rows divided by the deviation σ_i of motor i's residual,

    g_i v_i = (T W χ + T E(p) c + T W_L p)_i,

with the effects E c of the calibration in the model. Load friction, elasticity and saturation
depend on the body: E is built from the torques that the last p predicts, until p stays. Beside runs
without load, χ and c are found again, together with p: only the gains are taken from the
calibration. Without such runs, χ and c are the calibration's, except the friction of the joints,
which is found again because it changes with the temperature.

σ has three parts. One leaves out a move at a time, as that of a gain (`jackknife_covariance`).
Another, S C Sᵀ, is what the errors of the calibration do to p: C is its covariance,
S = ∂p/∂(g, χ, c). The last is the tolerance u_k of the mass m_k of each payload that gave the
calibration its scale, which C lacks: p moves by the vector S ∂(g, χ, c)/∂m_k u_k, and its outer
product with itself is added. Where that mass was all that was known, the vector is p u_k/m_k.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray, takes
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run, require_entry
from ident.effects.effect import PlacedEffect, effect_torque
from ident.effects.geometry_corrections import corrected_dataset, corrected_model
from ident.effects.rotor import beside_rotors
from ident.effects.signals import Signals, declared_signals
from ident.equations.linearisation import jackknife_covariance
from ident.equations.observation import Observation, observe
from ident.equations.reduction import standard_equations
from ident.equations.system import System
from ident.equations.triangles import solve
from ident.errors import DataUnfit
from ident.estimators.estimate import RelativeError, relative_error
from ident.model.base import base_parameters
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, steiner
from ident.model.model import Column, Model
from ident.model.robot import Place
from ident.planning.excitation import UNSEEN, side_of_cube
from ident.planning.gain_verdict import ExtraMoves
from ident.prediction import corrections_of, left_of, placed_effects, standard_parameters

MAX_PASSES = 8  #: Of the effects' columns; load friction of a tenth of the load needs three
#: Largest change of the body in the last pass, as a share of its size; each is some 3 % of the one
#: before
STAYS = 1e-3
WORTH = 0.7  #: Share of its σ to which moves must bring a parameter in order to be named
KNOWN = 0.1  #: Largest σ of a parameter that counts as identified, as a share of its value
FRICTION = ("fv", "fs")  #: First letters of friction's columns, of joints and of coupled motors


@dataclass(frozen=True, slots=True, eq=False)
class RowsToWeigh:
    """Rows of runs without load, then of runs with the body, for any calibration of the robot."""

    model: Model  #: the declared model
    datasets: tuple[Dataset, ...]  #: the runs, without load first
    bare: int  #: number of runs without load
    rows: Observation  #: with every standard column, then the ten of the body

    @property
    def loaded(self) -> BoolArray:
        """Rows in which the body was mounted, shape (r,)."""
        return np.asarray(self.rows.run >= self.bare)


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """The linear problem that a body was weighed with, for predictions about further moves.

    Its columns are the standard ones, the body's ten, and those of effects.
    """

    model: Model  #: the declared model
    #: which columns belong to unknowns, whether the motion shows them or not, shape (u,)
    unknowns: IntArray
    weight: FloatArray  #: 1/(g_i σ_i) of each motor, shape (m,)
    information: FloatArray  #: AᵀA of the unknowns, shape (u, u)
    beside_bare_runs: bool  #: the robot was found together with the body


@dataclass(frozen=True, slots=True, eq=False)
class WeighedBody:
    """A body on the flange; parameters in its joint's frame, in the order of LINK_PARAMETERS."""

    values: FloatArray  #: NaN for a parameter that the motion does not show, shape (10,) [SI]
    #: From leaving out moves, the calibration taken as exact; NaN likewise, shape (10, 10).
    moves_covariance: FloatArray
    #: With the errors of the calibration and the tolerance of its reference masses; NaN likewise,
    #: shape (10, 10).
    covariance: FloatArray
    #: The calibration has its covariance. Otherwise σ adds the errors of the gains by size, because
    #: one weight sets their common scale, and lacks those of the robot's parameters and of the
    #: effects.
    complete: bool
    moves: int  #: separate moves behind σ
    error: RelativeError  #: ‖ρ‖/‖Y‖ with the body in the model, on the runs that carried it [%]
    scale: Scale  #: the equations
    #: The part of `covariance` that is the tolerance of the masses that the calibration was made
    #: with; NaN likewise, shape (10, 10).
    reference_covariance: FloatArray = field(default_factory=lambda: np.zeros((10, 10)))

    @property
    def std(self) -> FloatArray:
        """σ of each parameter, shape (10,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def mass_kg(self) -> float:
        """m [kg]; NaN where the motion does not show it."""
        return float(self.values[-1])

    @property
    def mass_std_kg(self) -> float:
        """σ of m [kg]."""
        return float(self.std[-1])

    @property
    def mass_reference_std_kg(self) -> float:
        """Share of σ of m from the tolerance of the reference masses [kg]; 0 without any."""
        return float(np.sqrt(self.reference_covariance[-1, -1]))

    @property
    def centre_m(self) -> tuple[FloatArray, FloatArray]:
        """Centre of mass in the carrying joint's frame and its σ [m], shapes (3,)."""
        return self._derived(_centre)

    def centre_in(self, frame: Place) -> tuple[FloatArray, FloatArray]:
        """Centre of mass in a frame that is fixed to that joint, and its σ [m], shape (3,) each."""
        to_frame = frame.rotation.T
        # A coordinate that is not shown spoils those of the frame that depend on it, and no others.
        depends = np.abs(to_frame) > 1e-12

        def centre_in_frame(body: FloatArray) -> FloatArray:
            from_origin = _centre(body) - frame.translation_m
            terms = np.where(depends, to_frame * from_origin, 0.0)
            return np.asarray(terms.sum(axis=1))

        return self._derived(centre_in_frame)

    @property
    def inertia_kg_m2(self) -> tuple[FloatArray, FloatArray]:
        """Inertia about the centre of mass and its σ [kg m²], shape (6,) each.

        In the order Ixx, Ixy, Ixz, Iyy, Iyz, Izz.
        """
        return self._derived(_about_centre)

    @property
    def size(self) -> FloatArray:
        """m a², m a and m of a steel cube of side a: compact, hence small, shape (10,).

        Its mass is the least one that these moves allow, m − 2 σ; 1 kg where they do not show the
        mass.
        """
        mass = 1.0
        if np.isfinite(self.mass_kg):
            mass = max(abs(self.mass_kg) - 2.0 * self.mass_std_kg, 0.0)
        side = side_of_cube(mass)
        inertias = np.full(6, mass * side**2)
        moments = np.full(3, mass * side)
        return np.concatenate((inertias, moments, [mass]))

    @property
    def identifiable(self) -> BoolArray:
        """Parameters known to KNOWN of their value, or to that of a compact body, shape (10,).

        The second, what a compact body of this mass has, counts for a parameter near zero; the
        first for one with a long lever, such as Izz about a far joint. The mass itself has the
        first alone.
        """
        std = np.nan_to_num(self.std, nan=np.inf)
        is_known = std <= KNOWN * np.abs(np.nan_to_num(self.values))
        is_small = 2.0 * std < self.size
        is_small[-1] = False
        return np.asarray(is_known | is_small)

    def _derived(
        self, quantity: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        with np.errstate(invalid="ignore"):  # NaN is what depends on a parameter that is not shown
            value = quantity(self.values)
            # Complex steps differentiate polynomials and quotients exactly.
            slopes: list[FloatArray] = []
            for step in 1e-20j * np.eye(10):
                stepped = quantity(self.values + step)
                slopes.append(stepped.imag / 1e-20)
        shown = np.isfinite(self.values)
        slope = np.stack(slopes, axis=1)[:, shown]
        covariance = self.covariance[np.ix_(shown, shown)]
        # σ_i² = Σ_jk s_ij C_jk s_ik
        variance = np.einsum("ij,jk,ik->i", slope, covariance, slope)
        std = np.sqrt(variance)
        return value, np.where(np.isfinite(value), std, np.nan)


def _centre(body: FloatArray) -> FloatArray:
    first_moments = body[6:9]
    mass = body[9]
    return np.asarray(first_moments / mass)


def _about_centre(body: FloatArray) -> FloatArray:
    # I − (‖c‖² 1 − c cᵀ)/m, c the first moments
    inertia = body[:6]
    moved = steiner(body[6:9])[np.triu_indices(3)]
    mass = body[9]
    return np.asarray(inertia - moved / mass)


@takes(
    calibration=Calibration,
    model=Model,
    loaded=Iterable,
    conditioning=Conditioning | None,
    bare=Iterable,
)
def weigh(
    calibration: Calibration,
    model: Model,
    loaded: Iterable[Run],
    conditioning: Conditioning | None = None,
    *,
    bare: Iterable[Run] = (),
) -> WeighedBody:
    """Weigh the body that some runs carry; what they say of their payload is ignored.

    Args:
        calibration: gains, parameters and effects of this robot.
        model: the declared model that the calibration was fitted with.
        loaded: runs with the same body, mounted the same way.
        conditioning: the filters; those of the calibration's fit when None.
        bare: runs of the same robot without load. With them, σ does not depend on the calibration's
            parameters.

    Raises:
        DataUnfit: a run is unfit, or no row of the runs counts.
        TooFewMoves: σ needs more moves.
        ModelError, EffectRefused: the calibration is of another robot, or holds an unknown effect.
    """
    if conditioning is None:
        conditioning = calibration.conditioning
    rows = rows_to_weigh(model, loaded, conditioning, bare=bare)
    return weigh_rows(calibration, rows)


def rows_to_weigh(
    model: Model, loaded: Iterable[Run], conditioning: Conditioning, *, bare: Iterable[Run] = ()
) -> RowsToWeigh:
    """Build the rows of runs once, for weighing with several calibrations.

    Raises:
        DataUnfit: a run is unfit or leaves no usable row, or no run carries the body.
    """

    def prepared(runs: Iterable[Run]) -> list[Dataset]:
        made: list[Dataset] = []
        for run in runs:
            require_entry(run)
            without_payload = replace(run, payload=None)
            made.append(differentiate(without_payload, model.drive_train, conditioning))
        return made

    without = prepared(bare)
    mounted = prepared(loaded)
    if not mounted:
        raise DataUnfit("", "no run with the body to weigh was given; expected at least one")
    return _rows_of(model, (*without, *mounted), len(without), conditioning)


def _rows_of(
    model: Model, datasets: tuple[Dataset, ...], bare: int, conditioning: Conditioning
) -> RowsToWeigh:
    """Build the rows of runs, those without the body first."""
    rows = observe(model, datasets, conditioning, standard_equations(model))
    is_mounted = rows.run >= bare
    if model.friction_by_payload:
        # What the runs say of their payload is ignored, but their friction is that of a loaded arm.
        regressor = rows.regressor.copy()
        friction = regressor[:, model.friction_columns]
        regressor[:, model.loaded_friction_columns] = friction * is_mounted
        rows = replace(rows, regressor=regressor)
    body: list[Column] = []
    for name, unit in zip(LINK_PARAMETERS, LINK_UNITS, strict=True):
        body.append(Column(f"{name}:body", unit))
    rows = rows.extended(tuple(body), rows.flange * is_mounted)
    return RowsToWeigh(model, datasets, bare, rows)


def _corrected(given: RowsToWeigh, corrections: tuple[PlacedEffect, ...]) -> RowsToWeigh:
    """The rows of the robot as a calibration has corrected its description."""
    if not corrections:
        return given
    model = corrected_model(given.model, corrections)
    datasets = tuple(corrected_dataset(data, corrections) for data in given.datasets)
    return _rows_of(model, datasets, given.bare, given.rows.conditioning)


@dataclass(frozen=True, slots=True, eq=False)
class _CalibratedValues:
    """What a calibration says of the robot, in the order of the columns of the weighing."""

    model: Model  #: with the calibration's corrections of the geometry
    gains: FloatArray  #: shape (m,)
    standard: FloatArray  #: χ, shape (p,)
    #: those that correct the geometry are in `model`, and zero here
    effects: tuple[PlacedEffect, ...]
    coefficients: tuple[FloatArray, ...]  #: c of each effect
    session_began_s: float | None

    @property
    def values(self) -> FloatArray:
        """Value of each column: χ, the body's ten as zeros, c; shape (p + 10 + c,)."""
        return np.concatenate((self.standard, np.zeros(10), *self.coefficients))

    @property
    def body_columns(self) -> IntArray:
        """Columns of the body's ten, shape (10,)."""
        first = len(self.standard)
        return np.arange(first, first + 10)

    @property
    def effects_depend_on_body(self) -> bool:
        """Whether the columns of an effect are built from the torques that the model predicts."""
        abscissas = [placed.effect.abscissa for placed in self.effects]
        return not all(abscissa.is_independent_of_model for abscissa in abscissas)

    def signals(self, datasets: Sequence[Dataset], body: FloatArray | None) -> list[Signals]:
        """Signals that the effects are built from, one for each run; none without effects."""
        if not self.effects:
            return []
        parameters = self.model.with_payload(self.standard, body)
        made: list[Signals] = []
        for data in datasets:
            of_robot = declared_signals(
                self.model, data, parameters, self.gains, self.session_began_s
            )
            made.append(beside_rotors(of_robot, list(self.effects)))
        return made


@dataclass(frozen=True, slots=True, eq=False)
class _WeighingSolution:
    """Least-squares solution of the motors' equations, for one set of effect columns."""

    rows: Observation  #: with the columns of the effects
    system: System  #: of all columns
    free_system: System  #: of the free columns, with the others at their values
    unknowns: IntArray  #: columns of the unknowns
    free: tuple[int, ...]  #: the independent ones of them, in order
    blurred: tuple[int, ...]  #: those of the body that gather others of its parameters
    fixed: tuple[int, ...]  #: all other columns
    parameters: FloatArray  #: of the free columns
    noise: FloatArray  #: σ of each motor's residual current, shape (m,)
    values: FloatArray  #: of all columns


def weigh_rows(calibration: Calibration, given: RowsToWeigh) -> WeighedBody:
    """Weigh the body with rows that are at hand; errors are those of `weigh`."""
    given = _corrected(given, corrections_of(calibration))
    robot = _robot_of(calibration, given.model)
    solution = _solved(robot, given)
    gains = robot.gains
    motor_count = len(gains)
    ten = robot.body_columns
    free = solution.free
    body = solution.values[ten]
    is_of_body = np.isin(free, ten)
    is_shown = np.isin(ten, free)

    jackknifed = jackknife_covariance(
        solution.free_system, gains, solution.parameters, solution.noise, gains_fixed=True
    )
    of_free = jackknifed[motor_count:, motor_count:]
    of_moves = np.zeros((10, 10))
    of_moves[np.ix_(is_shown, is_shown)] = of_free[np.ix_(is_of_body, is_of_body)]

    system = solution.system
    weight = 1.0 / (gains * solution.noise)
    has_moved = system.motors.rows > 0
    # A motor that never moved is as noisy as the others, should further moves need it.
    weight[~has_moved] = np.median(np.abs(weight[has_moved]))
    noise = 1.0 / (gains * weight)
    whitened = system.currents.whitened(gains, noise)
    columns = whitened.linear

    # ∂p/∂(g, fixed parameters): each moves the body by what it moves the right-hand side.
    fixed = list(solution.fixed)
    of_fixed = columns[:, fixed]
    right_hand_sides = np.concatenate((whitened.drive, -of_fixed), axis=1)
    free_slope, _ = solve(columns[:, list(free)], right_hand_sides)
    slope = np.zeros((10, motor_count + len(fixed)))
    slope[is_shown] = free_slope[is_of_body]
    fixed_names = [solution.rows.columns[index].name for index in fixed]
    of_calibration = _of_calibration(calibration, gains, slope, fixed_names)
    of_reference = _of_reference_mass(calibration, body, slope, fixed_names)

    is_separate = is_shown & ~np.isin(ten, solution.blurred)
    nan_where_unseen = np.where(is_separate, 0.0, np.nan)
    nan_pairs = nan_where_unseen + nan_where_unseen[:, None]
    covariance = of_moves + of_calibration + of_reference
    unknown_columns = columns[:, solution.unknowns]
    scale = Scale(
        model=given.model,
        unknowns=solution.unknowns,
        weight=weight,
        information=unknown_columns.T @ unknown_columns,
        beside_bare_runs=given.bare > 0,
    )
    return WeighedBody(
        values=body + nan_where_unseen,
        moves_covariance=of_moves + nan_pairs,
        covariance=covariance + nan_pairs,
        complete=calibration.covariance_factor is not None,
        moves=len(system.clusters),
        error=_error_with_body(solution, given.loaded, gains),
        scale=scale,
        reference_covariance=of_reference + nan_pairs,
    )


def _robot_of(calibration: Calibration, model: Model) -> _CalibratedValues:
    effects: list[PlacedEffect] = []
    coefficients: list[FloatArray] = []
    for fitted, fitted_values in placed_effects(calibration):
        placed, values = left_of(fitted, fitted_values)
        effects.append(placed)
        coefficients.append(values)
    gains = [gain.value for gain in calibration.gains]
    return _CalibratedValues(
        model=model,
        gains=np.array(gains),
        standard=standard_parameters(calibration, model),
        effects=tuple(effects),
        coefficients=tuple(coefficients),
        session_began_s=calibration.session_began_s,
    )


def _solved(robot: _CalibratedValues, given: RowsToWeigh) -> _WeighingSolution:
    """Solve for the body, again and again while its torques change the columns of the effects."""
    without_body = given.datasets[: given.bare]
    with_body = given.datasets[given.bare :]
    bare_signals = robot.signals(without_body, None)
    passes = 1
    if robot.effects_depend_on_body:
        passes = MAX_PASSES
    body = np.zeros(10)
    for _ in range(passes):
        signals = (*bare_signals, *robot.signals(with_body, body))
        solution = _solved_with(robot, given, signals)
        previous_body = body
        body = solution.values[robot.body_columns]
        change = np.linalg.norm(body - previous_body)
        if change <= STAYS * np.linalg.norm(body):
            break
    return solution


def _solved_with(
    robot: _CalibratedValues, given: RowsToWeigh, signals: Sequence[Signals]
) -> _WeighingSolution:
    """Solve for the body, with the columns of the effects from these signals."""
    rows = given.rows
    for placed in robot.effects:
        torque = effect_torque(
            placed.effect, placed.axis, signals, given.datasets, rows.conditioning, robot.model
        )
        rows = rows.extended(placed.columns, torque)
    system = rows.system()
    values = robot.values
    has_bare_runs = given.bare > 0
    unknowns, free, blurred = _unknowns(
        system, robot.body_columns, robot.model, beside_bare_runs=has_bare_runs
    )
    fixed = tuple(index for index in range(len(values)) if index not in free)
    fixed_values = {index: float(values[index]) for index in fixed}
    free_system = system.holding(fixed_values)
    parameters, noise = free_system.currents.settled(robot.gains, len(free))
    values[list(free)] = parameters
    return _WeighingSolution(
        rows=rows,
        system=system,
        free_system=free_system,
        unknowns=unknowns,
        free=free,
        blurred=blurred,
        fixed=fixed,
        parameters=parameters,
        noise=noise,
        values=values,
    )


def _error_with_body(
    solution: _WeighingSolution, is_loaded: BoolArray, gains: FloatArray
) -> RelativeError:
    """Relative error of the torques on the rows that carried the body."""
    rows = solution.rows
    regressor = np.concatenate((rows.regressor, rows.effects), axis=1)
    # τ_jr = Σ_p W_jpr χ_p
    predicted = np.einsum("jpr,p->jr", regressor[:, :, is_loaded], solution.values)
    measured = rows.torque(gains, is_loaded)
    return relative_error(measured, predicted, rows.use[:, is_loaded])


def _unknowns(
    system: System, ten: IntArray, model: Model, *, beside_bare_runs: bool
) -> tuple[IntArray, tuple[int, ...], tuple[int, ...]]:
    """Find the columns that a body is weighed by.

    Returns:
        those of the unknowns; the independent ones among them; those of the body that gather others
        of its parameters.
    """
    names = [column.name for column in system.columns]
    robot = [index for index in range(len(names)) if index not in ten]
    if not beside_bare_runs:
        declared = robot[: len(model.columns)]
        robot = [index for index in declared if names[index].startswith(FRICTION)]
    unknowns = np.array([*robot, *ten])
    parts = [factor[:, system.axis_count : -1] for factor in system.joints.factors]
    columns = np.concatenate(parts)[:, unknowns]
    base = base_parameters(columns, tuple(names[index] for index in unknowns))
    free = unknowns[list(base.independent)]
    every = np.arange(len(unknowns))
    dependent = np.setdiff1d(every, base.independent)
    gathers_others = np.any(base.grouping[:, dependent] != 0.0, axis=1)
    blurred = free[gathers_others & np.isin(free, ten)]
    return unknowns, tuple(sorted(free.tolist())), tuple(blurred.tolist())


def _of_calibration(
    calibration: Calibration, gains: FloatArray, slope: FloatArray, held: Sequence[str]
) -> FloatArray:
    """Covariance of the ten that comes from the calibration's errors, shape (10, 10).

    Args:
        calibration: with its covariance, or with the σ of its gains alone.
        gains: its gains, shape (m,).
        slope: ∂p/∂(g, held parameters), shape (10, n + h).
        held: names of the columns held, leading names for base parameters.
    """
    count = len(gains)
    covariance = calibration.covariance
    if covariance is None:
        to_gains = slope[:, :count]
        gains_std = [gain.std for gain in calibration.gains]
        size = np.abs(to_gains) @ gains_std
        together = np.sign(to_gains @ gains) * size
        return np.outer(together, together)
    used = _slope_to_calibration(calibration, slope, held)
    return np.asarray(used @ covariance @ used.T)


def _slope_to_calibration(
    calibration: Calibration, slope: FloatArray, held: Sequence[str]
) -> FloatArray:
    """∂p/∂(gains, parameters of the calibration) from that to held columns, shape (10, n + p)."""
    count = len(calibration.gains)
    columns = {name: column for column, name in enumerate(held, start=count)}
    used = np.zeros((len(slope), count + len(calibration.parameters)))
    used[:, :count] = slope[:, :count]
    for index, parameter in enumerate(calibration.parameters, start=count):
        leading_name, *_ = parameter.name.split()
        column = columns.get(parameter.name, columns.get(leading_name))
        if column is not None:
            used[:, index] = slope[:, column]
    return used


def _of_reference_mass(
    calibration: Calibration, body: FloatArray, slope: FloatArray, held: Sequence[str]
) -> FloatArray:
    """Covariance of the ten from the tolerance of the reference masses, shape (10, 10).

    Args:
        calibration: with the derivatives of its gains and parameters to these masses. Without those
            of the parameters, the body is taken in proportion to the mass, as it is where nothing
            else is known of that payload.
        body: the ten, shape (10,).
        slope: ∂p/∂(g, held parameters), shape (10, n + h).
        held: names of the columns held.
    """
    count = len(slope)
    covariance = np.zeros((count, count))
    used = _slope_to_calibration(calibration, slope, held)
    for reference in calibration.payload_mass:
        if reference.tolerance_kg == 0.0:
            continue
        if len(reference.parameters_per_kg) == len(calibration.parameters):
            gains_per_kg = [gain.per_kg for gain in reference.gains]
            per_kg = np.concatenate((gains_per_kg, reference.parameters_per_kg))
            body_per_kg = used @ per_kg
        else:
            body_per_kg = body / reference.mass_kg
        shift = reference.tolerance_kg * body_per_kg
        covariance += np.outer(shift, shift)
    return covariance


@dataclass(frozen=True, slots=True)
class Help:
    """Moves that would show a parameter of the body better."""

    name: str  #: of the parameter
    words: str  #: the moves, to follow "add": ``fast moves of J6 with the arm stretched``
    seconds: float  #: their duration
    std: float  #: predicted σ of the parameter with them [SI]


def moves_that_help(weighed: WeighedBody, extras: Sequence[ExtraMoves]) -> tuple[Help, ...]:
    """Name for each parameter that is not `identifiable` the moves that would show it best.

    Args:
        weighed: the body.
        extras: moves that could be made with it, and without load too where it was weighed beside
            bare runs.

    Returns:
        an entry for each parameter that some of them bring to WORTH of its σ or less.
    """
    if not extras:
        return ()
    scale = weighed.scale
    unknown_count = len(scale.unknowns)
    ten = np.arange(unknown_count - 10, unknown_count)
    std = np.sqrt(np.diag(weighed.moves_covariance))
    std_by_rows = _std(scale.information, ten)
    # Rows are correlated, and moves scatter more than rows say: the prediction is of the ratio.
    factor = 1.0
    is_usable = np.isfinite(std) & np.isfinite(std_by_rows)
    if is_usable.any():
        ratio = std / std_by_rows
        factor = float(np.median(ratio[is_usable]))
    predicted: list[FloatArray] = []
    for extra in extras:
        information = scale.information + _information(scale, extra)
        predicted.append(factor * _std(information, ten))
    std_with_extra = np.stack(predicted)  # of each extra and parameter
    largest_std = WORTH * np.nan_to_num(std, nan=np.finfo(np.float64).max)
    found: list[Help] = []
    for index in np.flatnonzero(~weighed.identifiable).tolist():
        best = int(np.argmin(std_with_extra[:, index]))
        best_std = float(std_with_extra[best, index])
        if best_std <= largest_std[index]:
            extra = extras[best]
            found.append(Help(LINK_PARAMETERS[index], extra.words, extra.seconds, best_std))
    return tuple(found)


def _information(scale: Scale, extra: ExtraMoves) -> FloatArray:
    """JᵀJ of moves with the body, and of the same without load where the robot is unknown too."""
    model = scale.model
    unknowns = scale.unknowns
    of_robot = model.regressor(extra.excitation.motion, loaded=True)
    of_body = of_robot[:, model.flange]
    columns = np.concatenate((of_robot, of_body), axis=1)
    # A_icr = w_i Σ_j T_ij W_jcr
    weighted_to_motor = model.drive_train.to_motor * scale.weight[:, None]
    by_motor = np.tensordot(weighted_to_motor, columns, axes=1)
    by_motor *= extra.excitation.use[:, None, :]
    motors, column_count, samples = by_motor.shape
    row_count = motors * samples
    is_known = unknowns < column_count  # effects come after; their torque is small
    known = by_motor[:, unknowns[is_known]]
    rows = np.zeros((row_count, len(unknowns)))
    rows[:, is_known] = known.transpose(0, 2, 1).reshape(row_count, -1)
    information = rows.T @ rows
    if scale.beside_bare_runs:
        is_of_body = unknowns >= of_robot.shape[1]
        is_of_load = np.isin(unknowns, model.loaded_friction_columns)
        rows[:, is_of_body | is_of_load] = 0.0
        information += rows.T @ rows
    return information


def _std(information: FloatArray, wanted: IntArray) -> FloatArray:
    """σ of some unknowns; inf for one that the information does not fix."""
    unit = np.sqrt(np.diag(information))
    # Rounding, which scaled up would look like information
    is_rounding = unit <= UNSEEN * unit.max()
    unit[is_rounding] = np.inf
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    is_seen = values > UNSEEN * values[-1]
    # σ_i² = Σ_k v_ik²/λ_k over the directions that are seen
    shares = vectors[wanted] ** 2
    variance = shares[:, is_seen] @ (1.0 / values[is_seen])
    std = np.sqrt(variance) / unit[wanted]
    unseen_share = shares[:, ~is_seen].sum(axis=1)
    return np.where(unseen_share > 1e-6, np.inf, std)
