"""Gross mistakes of geometry: another gravity, a position that counts the other way, a far zero.

Each makes the equations of most motors wrong at once, and its traces look like those of wrong
currents: a gain of the wrong sign, a large error, an iteration that does not converge. So geometry
is judged before the currents are.

**Fit.** Each hypothesis about the geometry is fitted to some hundred rows of each run,

    v_i = s_i (T W χ)_i        of motor i, with s_i = ± 1/g_i,

by least squares for χ and s in turn, each motor weighted by its own error. Signs and a common scale
of s are free, and each s_i within LARGEST_FACTOR of its nameplate: neither reversed currents nor a
payload of wrong mass, nor any unit, take part in the judgement. Everything is done in products of
the columns [W | v_i].

**Gravity** enters W linearly, W(g) = A + Σ_k g_k G_k, so products of [A | G_x | G_y | G_z | v_i]
serve every direction. A direction opposite to the right one is stationary; therefore the search
begins at 26 directions and goes on from the best by Gauss-Newton. σ of the direction comes from
leaving out parts of the moves in turn.

**Readings.** A position is read the other way, or from another zero: descriptions differ in whether
an arm stands upright or lies at zero. The search begins at zeros in steps of 45° and goes on from
the best; a small zero offset is an effect of the description
(`ident.effects.geometry_corrections.ZeroOffset`): its linear column leads less far.

**Judgement.** Another gravity makes other parameters identifiable. So each part of the moves is
predicted from a fit of the others, and a hypothesis must lower the errors of these predictions, in
sum over the motors and in most parts. It must do so beside each small correction as well: gravity
that leans by some degrees, or a zero that is off by some. A large turn of one joint imitates them,
where the joint moves little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy  # loads its modules when they are first used
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, IntArray, as_gains, require_entries, takes
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.equations.instants import Instants
from ident.equations.linearisation import scatter_of
from ident.errors import Diagnosis, IdentificationError, ModelError
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.estimators.refusals import FRICTION, LARGEST_TOTAL_PERCENT, SMALL_ERROR
from ident.model.base import SMALLEST_COLUMN
from ident.model.bodies import LINK_PARAMETERS
from ident.model.model import Model
from ident.model.robot import JointKind, Motion, at_rest
from ident.model.suggested_gravity import suggested_gravity

GRAVITY_TURNED = "gravity-turned"
POSITION_REVERSED = "position-reversed"
ZERO_TURNED = "zero-turned"
GEOMETRY = frozenset((GRAVITY_TURNED, POSITION_REVERSED, ZERO_TURNED))  #: Names of these diagnoses

PARTS = 8  #: Parts of the moves, of which each is predicted from the others
LEAST_FALL = 0.5
"""Least fall of the logarithm of the motors' errors, in sum.

See `make diagnosis-study` for false alarms.
"""
LEAST_T = 4.0  #: Least mean of the falls of the parts, in σ of that mean
#: Smaller turns of gravity are no gross mistake: they are an effect of the mounting
SMALLEST_TURN_DEG = 10.0
LARGEST_DIRECTION_STD_DEG = 10.0  #: A direction that is less certain is not named
ALIKE_FALL = 0.85
"""Share of the largest fall above which a hypothesis is as good.

A mirror image of an arm has the same torques.
"""
LARGEST_FACTOR = 3.0  #: Of a gain beside its nameplate and the other gains
SCREENED_ROWS = 500  #: Rows of all runs together with which every recording is screened
ZERO_TURNS_DEG = (45.0, 90.0, 135.0, 180.0, -135.0, -90.0, -45.0)
"""Zeros of a revolute joint from which the search begins."""
ZERO_REACH_RAD = 0.5  #: How far it goes from there
ZERO_TOLERANCE_RAD = 2e-3
SMALL_ZERO = float(np.deg2rad(ZERO_TURNS_DEG[0])) - ZERO_REACH_RAD
"""Largest small correction of a zero [rad or m]; the search for large ones finds any larger."""
SUSPECT_ERROR = 0.2
"""Error of the worst current, of its size, from which another zero is looked for.

45° of a joint that bears anything leave more.
"""
#: Fall of the errors of the fits themselves, as LEAST_FALL, above which predictions are judged
SUSPECT_FALL = 0.25
RIDGE = 1e-7  #: Added to products of columns of unit length, for combinations that no row shows
#: Rounds of a fit from the nameplate, and of one from a neighbouring solution
FIT_ROUNDS, NEXT_ROUNDS = 6, 2
TURN_ROUNDS = 6  #: Of Gauss-Newton
LARGEST_STEP_RAD = 0.5  #: Up to which a step of the direction is trusted
UNTIL_RIGHT = "gains and errors mean nothing until it is right"  #: End of each remedy for a fit
RUN_UNTIL_RIGHT = "what is predicted of this run means nothing until it is right"
"""The same for a run that the fit has not seen: its gains are those of other recordings."""
WHICH_IS_WRONG = (
    "these moves do not tell them apart: look how the base is mounted and where the zeros are, or "
    "record moves through more of the range of all joints; correct what is wrong, and fit again"
)
"""Remedy where several explain the same."""
WEIGHTY = tuple(index for index, name in enumerate(LINK_PARAMETERS) if name.startswith("m"))
"""Parameters of a body that gravity acts on: first moments and mass."""


# Hypotheses


@dataclass(frozen=True, slots=True)
class PositionReading:
    """Another reading of the positions of one axis: the other way, or from another zero."""

    axis: int
    sign: float = 1.0
    zero_rad: float = 0.0  #: added to its positions

    def positions(self, position_rad: FloatArray) -> FloatArray:
        """Positions of all axes in this reading [rad or m], shape (k, m)."""
        read = position_rad.copy()
        read[:, self.axis] = self.sign * position_rad[:, self.axis] + self.zero_rad
        return read

    def motion(self, motion: Motion) -> Motion:
        """Motion of all axes in this reading."""
        signs = np.ones(motion.position_rad.shape[1])
        signs[self.axis] = self.sign
        position_rad = self.positions(motion.position_rad)
        velocity_rad_s = motion.velocity_rad_s * signs
        acceleration_rad_s2 = motion.acceleration_rad_s2 * signs
        return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)

    def text(self, axes: Sequence[str]) -> str:
        """The mistake in words."""
        name = axes[self.axis]
        if self.sign < 0.0:
            return f"{name} reversed"
        zero_deg = np.rad2deg(self.zero_rad)
        return f"the zero of {name} off by about {zero_deg:+.0f} deg"


@dataclass(frozen=True, slots=True, eq=False)
class GravityFound:
    """Direction of gravity by the recordings."""

    declared_m_s2: FloatArray  #: in the base frame, shape (3,)
    found_m_s2: FloatArray  #: of the same size, shape (3,)
    std_deg: float  #: σ of the direction, in its worst plane

    @property
    def turned_deg(self) -> float:
        """Angle between the two [deg]."""
        declared_square = float(np.sum(self.declared_m_s2**2))
        cosine = self.declared_m_s2 @ self.found_m_s2 / declared_square
        angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        return float(np.rad2deg(angle_rad))


@dataclass(frozen=True, slots=True, eq=False)
class TurnedGeometry:
    """Another geometry than the declared one, which predicts left-out moves clearly better."""

    gravity: GravityFound | None  #: where gravity is turned
    #: else the reading of a position; then others that explain the same
    readings: tuple[PositionReading, ...]
    #: axes whose gains have another sign than their nameplates in this geometry
    reversed_currents: tuple[int, ...]
    #: error of each motor's current on left-out moves, as declared, shape (m,)
    before_percent: FloatArray
    after_percent: FloatArray  #: the same in this geometry

    def model(self, declared: Model) -> Model:
        """The model with this gravity; for readings of a position see `corrected_positions`."""
        if self.gravity is None:
            return declared
        return with_gravity(declared, self.gravity.found_m_s2)

    def corrected_positions(self, position_rad: FloatArray) -> FloatArray:
        """Positions of a run in this geometry [rad or m], shape (k, m)."""
        if self.gravity is not None:
            return position_rad
        return self.readings[0].positions(position_rad)

    def diagnosis(self, axes: Sequence[str], runs: tuple[str, ...] = ()) -> Diagnosis:
        """Name the mistake.

        Args:
            axes: their names.
            runs: that it was found in, empty for those of a fit.
        """
        until_right = UNTIL_RIGHT
        if runs:
            until_right = RUN_UNTIL_RIGHT
        after = _percents(self.after_percent)
        before = _percents(self.before_percent)
        errors = f"errors of {after} % of the currents of left-out moves, {before} % as declared"
        alike = self.readings
        if self.gravity is None:
            alike = alike[1:]
        if alike:
            others = " or ".join(reading.text(axes) for reading in alike)
            errors = f"{errors}; explained as well by {others}"
        if self.gravity is not None:
            diagnosis = _turned_gravity_diagnosis(self.gravity, errors, until_right)
        elif self.readings[0].sign > 0.0:
            diagnosis = _turned_zero_diagnosis(self.readings[0], axes, errors, until_right)
        else:
            # Other readings that explain the same do not change what to do here.
            return self._reversed_position_diagnosis(axes, runs, errors, until_right)
        if alike:
            diagnosis = replace(diagnosis, remedy=f"{WHICH_IS_WRONG}: {until_right}")
        return replace(diagnosis, runs=runs)

    def _reversed_position_diagnosis(
        self, axes: Sequence[str], runs: tuple[str, ...], errors: str, until_right: str
    ) -> Diagnosis:
        reading = self.readings[0]
        name = axes[reading.axis]
        if reading.axis in self.reversed_currents:
            remedy = (
                f"reverse the <axis> of the joint of {name} in the URDF; or, in the cell file, its "
                "row of `drive_train.ratio` (`lead_mm` of a prismatic axis) and the sign of its "
                "nameplate gain"
            )
        else:
            remedy = (
                f"reverse the row of {name} in `drive_train.ratio` of the cell file (`lead_mm` of "
                "a prismatic axis), and leave its nameplate gain; of an import with `side: joint`, "
                "name it in `reversed` of `position`"
            )
        evidence = f"a position that counts the other way: so read, it leaves {errors}"
        expected = "each position to count about the axis of its joint in the URDF"
        advice = f"{remedy}; {until_right}"
        return Diagnosis(POSITION_REVERSED, runs, (name,), evidence, expected, advice)


def _turned_gravity_diagnosis(found: GravityFound, errors: str, until_right: str) -> Diagnosis:
    size_m_s2 = np.linalg.norm(found.found_m_s2)
    std_m_s2 = float(size_m_s2 * np.deg2rad(found.std_deg))
    suggested_m_s2 = suggested_gravity(found.found_m_s2, np.full(3, std_m_s2))
    direction = _numbers(found.found_m_s2 / size_m_s2)
    evidence = (
        f"gravity along {direction}, turned by {found.turned_deg:.1f} ± {found.std_deg:.1f} deg "
        f"from what the cell says, with {errors}"
    )
    expected = f"gravity along the declared {_numbers(found.declared_m_s2)}"
    remedy = (
        "how is the base mounted? correct `gravity_m_s2` of the cell: "
        f"{_numbers(suggested_m_s2)} m/s² by these recordings; {until_right}"
    )
    return Diagnosis(GRAVITY_TURNED, (), (), evidence, expected, remedy)


def _turned_zero_diagnosis(
    reading: PositionReading, axes: Sequence[str], errors: str, until_right: str
) -> Diagnosis:
    name = axes[reading.axis]
    zero_deg = np.rad2deg(reading.zero_rad)
    evidence = f"{reading.text(axes)}: so read, its position leaves {errors}"
    expected = "positions whose zero is that of the URDF"
    remedy = (
        f"add about {zero_deg:+.0f} deg to `zero_offset_deg` of {name} in the cell file, or move "
        f"the zero in the controller, and fit again: {until_right}"
    )
    return Diagnosis(ZERO_TURNED, (), (name,), evidence, expected, remedy)


def _percents(values: FloatArray) -> str:
    return ", ".join(f"{value:.2g}" for value in values)


def _numbers(values: FloatArray) -> str:
    rounded = np.round(values, 2) + 0.0  # no minus before a zero
    numbers = ", ".join(f"{value:.2f}" for value in rounded)
    return f"[{numbers}]"


def with_gravity(model: Model, gravity_m_s2: FloatArray) -> Model:
    """The same model under another gravity, shape (3,)."""
    robot = replace(model.robot, gravity_m_s2=gravity_m_s2)
    return replace(model, robot=robot)


@takes(model=Model, instants=Sequence)
def find_turned_geometry(
    model: Model, instants: Sequence[Instants], gains: ArrayLike
) -> TurnedGeometry | None:
    """Look for another geometry that explains recordings clearly better than the declared one.

    Args:
        model: the declared model; a redundantly driven robot is not judged, because internal
            preload is in every current.
        instants: rows of all runs.
        gains: nameplate, shape (m,).

    Returns:
        the hypothesis with the largest fall of the errors; None where the declared geometry is as
        good as any.

    Raises:
        ModelError: an argument is of another type or shape, or a gain is zero.
    """
    require_entries("instants", instants, Instants, "give `Identification.instants`")
    for of_run in instants:
        of_run.require_axes(model.robot.axis_count)
    if model.is_redundant or not instants:
        return None
    nameplate = as_gains("gains", gains, model.robot.axis_count)
    reference = 1.0 / np.abs(nameplate)
    if not _is_suspect(model, _thinned(instants), reference):
        return None
    weighed = gravity_products(model, instants)
    declared = model.robot.gravity_m_s2
    as_declared = weighed.directed(declared)
    start = first_fit(model, as_declared, reference)
    before = judge_hypothesis(as_declared, start, reference)
    judged = _other_readings(model, instants, before, start, reference)
    turned = _turned_gravity(weighed, declared, start, reference)
    if turned is not None:
        judged.append(turned)
    better = [one for one in judged if one.is_better(before)]
    if not better:
        return None
    small = _small_corrections(model, instants, weighed, start, reference)
    better = [one for one in better if one.stands_beside(small)]
    if not better:
        return None
    largest_fall = max(one.fall(before) for one in better)
    alike_fall = ALIKE_FALL * largest_fall
    alike = [one for one in better if one.fall(before) >= alike_fall]

    def order(one: Judged) -> tuple[float, bool, float]:
        # A mirror image of an arm needs more reversed currents than the mistake itself does. Where
        # a zero half a turn away explains the same as another gravity, the mounting is named first:
        # it is declared once for the whole arm.
        return one.contradictions(nameplate), one.gravity is None, -one.fall(before)

    alike.sort(key=order)
    chosen = alike[0]
    for correction in small:
        if correction.fall(before) >= alike_fall and not chosen.is_better(correction):
            alike.append(correction)
    fewest = chosen.contradictions(nameplate)
    readings: list[PositionReading] = []
    for one in alike:
        if one.reading is not None and one.contradictions(nameplate) == fewest:
            readings.append(one.reading)
    has_other_sign = chosen.fit.per_unit * nameplate < 0.0
    return TurnedGeometry(
        gravity=chosen.gravity,
        readings=tuple(readings),
        reversed_currents=tuple(np.flatnonzero(has_other_sign).tolist()),
        before_percent=before.percent,
        after_percent=chosen.percent,
    )


def _thinned(instants: Sequence[Instants]) -> tuple[Instants, ...]:
    """Keep SCREENED_ROWS of all runs together, evenly spaced."""
    count = sum(len(one.move) for one in instants)
    step = -(-count // SCREENED_ROWS)  # rounded up
    return tuple(one.every(step) for one in instants)


def _is_suspect(model: Model, instants: Sequence[Instants], reference: FloatArray) -> bool:
    """Whether another geometry may explain rows better, by the errors of the fits themselves.

    No direction of gravity leaves less than three directions at once, each with moments of its own,
    and another reading of a position has as many parameters as the declared one. Nearly all
    recordings need no other judgement.

    Args:
        model: the declared model.
        instants: few rows of all runs.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    weighed = gravity_products(model, instants, part_count=1)
    rows = weighed.rows.sum(axis=1)
    as_declared = weighed.directed(model.robot.gravity_m_s2)
    start = first_fit(model, as_declared, reference)
    square = as_declared.square[:, 0]
    as_read = improved(square, rows, start, reference, FIT_ROUNDS)
    limit = _log_error(square, as_read) - SUSPECT_FALL
    current_square = square[:, -1, -1]
    current_square = np.where(current_square > 0.0, current_square, 1.0)
    errors = np.sqrt(left_over(square, as_read) / current_square)
    is_gross = float(errors.max()) > SUSPECT_ERROR
    any_gravity = weighed.square[:, 0]
    fit = improved(any_gravity, rows, start, reference, FIT_ROUNDS)
    if _log_error(any_gravity, fit) < limit:
        return True
    for reading in _readings(model):
        if reading.sign > 0.0 and not is_gross:
            continue
        with suppress(ModelError):  # the loops of a closed chain cannot be closed so
            if _left_in_reading(model, instants, reading, start, reference) < limit:
                return True
    return False


def _readings(model: Model) -> Iterator[PositionReading]:
    """Each position the other way, and each angle from the zeros at which a search begins."""
    for axis in range(model.robot.axis_count):
        yield PositionReading(axis, sign=-1.0)
        yield from _turned_zeros(model, axis)


def _turned_zeros(model: Model, axis: int) -> tuple[PositionReading, ...]:
    """Readings of an angle from other zeros; none of a prismatic joint."""
    if model.robot.axes[axis].kind is JointKind.PRISMATIC:
        return ()
    zeros_rad = np.deg2rad(ZERO_TURNS_DEG)
    return tuple(PositionReading(axis, zero_rad=zero_rad) for zero_rad in zeros_rad.tolist())


def _best_zero(
    model: Model, instants: Sequence[Instants], axis: int, start: MotorFit, reference: FloatArray
) -> PositionReading | None:
    """The reading of an angle whose fit leaves least.

    There is none of a prismatic joint, or where no loop can be closed so.

    Args:
        model: the declared model.
        instants: few rows of all runs.
        axis: number of the axis.
        start: of the declared geometry.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """

    def left(zero_rad: float) -> float:
        try:
            reading = PositionReading(axis, zero_rad=zero_rad)
            return _left_in_reading(model, instants, reading, start, reference)
        except ModelError:  # the loops of a closed chain cannot be closed so
            return np.inf

    begins = [one.zero_rad for one in _turned_zeros(model, axis)]
    levels = [left(zero_rad) for zero_rad in begins]
    if not np.any(np.isfinite(levels)):
        return None
    near = begins[int(np.argmin(levels))]
    zero_rad, level = _least(left, near - ZERO_REACH_RAD, near + ZERO_REACH_RAD)
    best = near
    if level < min(levels):
        best = zero_rad
    if best > np.pi:
        best -= 2.0 * np.pi
    return PositionReading(axis, zero_rad=best)


def _other_readings(
    model: Model,
    instants: Sequence[Instants],
    before: Judged,
    start: MotorFit,
    reference: FloatArray,
) -> list[Judged]:
    """Judge each position the other way, and each angle from its best other zero."""
    few = _thinned(instants)
    tried = list[PositionReading]()
    for axis in range(model.robot.axis_count):
        tried.append(PositionReading(axis, sign=-1.0))
        turned = _best_zero(model, few, axis, start, reference)
        if turned is not None:
            tried.append(turned)
    judged = list[Judged]()
    for reading in tried:
        try:
            products = products_of_reading(model, instants, reading)
        except ModelError:  # the loops of a closed chain cannot be closed so
            continue
        near = start.in_reading(reading)
        square = products.square.sum(axis=1)
        rows = products.rows.sum(axis=1)
        fit = improved(square, rows, near, reference, FIT_ROUNDS)
        error = np.sqrt(left_over(square, fit))
        floored_error = np.maximum(error, before.smallest)
        falls = np.log(before.floored_error / floored_error)
        # Prediction is never better than the fit: most hypotheses end here
        if np.sum(falls) < LEAST_FALL:
            continue
        predicted = judge_hypothesis(products, near, reference)
        judged.append(replace(predicted, reading=reading))
    return judged


def _small_corrections(
    model: Model,
    instants: Sequence[Instants],
    weighed: GravityProducts,
    start: MotorFit,
    reference: FloatArray,
) -> list[Judged]:
    """Judge the best small correction of gravity, and of each zero.

    Those that grow beyond what is small are left out.

    Args:
        model: the declared model.
        instants: rows of all runs.
        weighed: products for any direction of gravity, of the same rows.
        start: of the declared geometry.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    judged = list[Judged]()
    declared = model.robot.gravity_m_s2
    solution = _descended(weighed, declared, start, reference)
    tilted = _judged_gravity(weighed, declared, solution, reference)
    if tilted.gravity is not None and tilted.gravity.turned_deg < SMALLEST_TURN_DEG:
        judged.append(tilted)
    few = _thinned(instants)
    for axis in range(model.robot.axis_count):
        try:
            reading = _small_zero(model, few, axis, start, reference)
            if reading is not None:
                products = products_of_reading(model, instants, reading)
                predicted = judge_hypothesis(products, start, reference)
                judged.append(replace(predicted, reading=reading))
        except ModelError:  # the loops of a closed chain cannot be closed so
            continue
    return judged


def _small_zero(
    model: Model, instants: Sequence[Instants], axis: int, start: MotorFit, reference: FloatArray
) -> PositionReading | None:
    """The small correction of a zero whose fit leaves least; None where a larger one leaves less.

    Arguments as for `_best_zero`.

    Raises:
        ModelError: the loops of a closed chain cannot be closed so.
    """

    def left(zero: float) -> float:
        reading = PositionReading(axis, zero_rad=zero)
        return _left_in_reading(model, instants, reading, start, reference)

    zero, _ = _least(left, -SMALL_ZERO, SMALL_ZERO)
    is_at_bound = SMALL_ZERO - abs(zero) < 2.0 * ZERO_TOLERANCE_RAD
    if is_at_bound:
        return None
    return PositionReading(axis, zero_rad=zero)


def _least(left: Callable[[float], float], lower: float, upper: float) -> tuple[float, float]:
    """Zero between two others that leaves least [rad or m], and what it leaves."""
    found = scipy.optimize.minimize_scalar(
        left,
        bounds=(lower, upper),
        method="bounded",
        options={"xatol": ZERO_TOLERANCE_RAD},
    )
    return float(found.x), float(found.fun)


def _left_in_reading(
    model: Model,
    instants: Sequence[Instants],
    reading: PositionReading,
    start: MotorFit,
    reference: FloatArray,
) -> float:
    """Logarithm of the motors' errors, in sum, where an axis is read otherwise.

    Arguments as for `_best_zero`.

    Raises:
        ModelError: the loops of a closed chain cannot be closed so.
    """
    products = products_of_reading(model, instants, reading, part_count=1)
    square = products.square[:, 0]
    rows = products.rows[:, 0]
    near = start.in_reading(reading)
    fit = improved(square, rows, near, reference, FIT_ROUNDS)
    return _log_error(square, fit)


def _turned_gravity(
    weighed: GravityProducts, declared: FloatArray, start: MotorFit, reference: FloatArray
) -> Judged | None:
    """Judge the best direction of gravity; None where it is near the declared one, or uncertain."""
    solution = best_gravity(weighed, declared, start, reference)
    judged = _judged_gravity(weighed, declared, solution, reference)
    gravity = judged.gravity
    if gravity is None or gravity.std_deg > LARGEST_DIRECTION_STD_DEG:
        return None
    if gravity.turned_deg >= max(SMALLEST_TURN_DEG, 3.0 * gravity.std_deg):
        return judged
    return None


def _judged_gravity(
    weighed: GravityProducts,
    declared: FloatArray,
    solution: tuple[FloatArray, MotorFit],
    reference: FloatArray,
) -> Judged:
    """Judge a direction of gravity by predictions of each part of the moves; σ by a jackknife.

    Args:
        weighed: products for any direction of gravity.
        declared: gravity of the model [m/s²], shape (3,).
        solution: gravity that explains all rows best [m/s²], shape (3,), and its fit.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    found, fit = solution
    directions = list[FloatArray]()
    left = list[FloatArray]()
    for part in range(PARTS):
        of_others, fit_of_others = _without(weighed, part, found, fit, reference)
        own = weighed.turned(weighed.square[:, part], of_others)
        directions.append(of_others)
        left.append(left_over(own, fit_of_others))
    unit = np.array(directions) / np.linalg.norm(found)
    largest_variance = np.linalg.eigvalsh(scatter_of(unit))[-1]
    std_deg = float(np.rad2deg(np.sqrt(largest_variance)))
    gravity = GravityFound(declared, found, std_deg)
    current_square = weighed.directed(found).current_square
    return Judged(fit, np.stack(left, axis=1), current_square, gravity=gravity)


def _without(
    weighed: GravityProducts, part: int, found: FloatArray, fit: MotorFit, reference: FloatArray
) -> tuple[FloatArray, MotorFit]:
    """Gravity and fit without one part of the moves, from those of all."""
    all_parts = weighed.square.sum(axis=1)
    all_rows = weighed.rows.sum(axis=1)
    others = all_parts - weighed.square[:, part]
    rows = all_rows - weighed.rows[:, part]
    gravity = found
    square = weighed.turned(others, gravity)
    for _ in range(NEXT_ROUNDS):
        fit = improved(square, rows, fit, reference, NEXT_ROUNDS)
        step = weighed.turn(others, gravity, fit)
        gravity = _moved(gravity, step)
        square = weighed.turned(others, gravity)
    return gravity, improved(square, rows, fit, reference, NEXT_ROUNDS)


def best_gravity(
    weighed: GravityProducts, declared: FloatArray, start: MotorFit, reference: FloatArray
) -> tuple[FloatArray, MotorFit]:
    """Gravity that explains all rows best, of the declared size, and its fit.

    Args:
        weighed: products for any direction of gravity.
        declared: gravity of the model [m/s²], shape (3,).
        start: of the declared geometry.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    level, fit = _fit_under(weighed, declared, start, reference)
    gravity = declared
    size = float(np.linalg.norm(declared))
    for direction in _grid():
        tried = size * direction
        tried_level, tried_fit = _fit_under(weighed, tried, start, reference)
        if tried_level < level:
            level = tried_level
            fit = tried_fit
            gravity = tried
    return _descended(weighed, gravity, fit, reference)


def _descended(
    weighed: GravityProducts, gravity: FloatArray, near: MotorFit, reference: FloatArray
) -> tuple[FloatArray, MotorFit]:
    """Gravity that explains all rows best near another one, by Gauss-Newton, and its fit.

    Arguments as for `best_gravity`.
    """
    square = weighed.square.sum(axis=1)
    level, fit = _fit_under(weighed, gravity, near, reference)
    for _ in range(TURN_ROUNDS):
        step = weighed.turn(square, gravity, fit)
        following = _moved(gravity, step)
        next_level, next_fit = _fit_under(weighed, following, fit, reference)
        if not next_level < level:
            break
        level = next_level
        fit = next_fit
        gravity = following
    return gravity, fit


def _fit_under(
    weighed: GravityProducts, gravity: FloatArray, near: MotorFit, reference: FloatArray
) -> tuple[float, MotorFit]:
    """Fit all rows under a gravity: the logarithm of the motors' errors, in sum, and the fit."""
    turned = weighed.turned(weighed.square.sum(axis=1), gravity)
    rows = weighed.rows.sum(axis=1)
    fit = improved(turned, rows, near, reference, NEXT_ROUNDS)
    return _log_error(turned, fit), fit


def _grid() -> list[FloatArray]:
    """Directions of the faces, edges and corners of a cube, 26 unit vectors."""
    directions = list[FloatArray]()
    for corner in product((-1.0, 0.0, 1.0), repeat=3):
        length = float(np.linalg.norm(corner))
        if length > 0.0:
            directions.append(np.array(corner) / length)
    return directions


def _moved(gravity: FloatArray, step: FloatArray) -> FloatArray:
    """Gravity after a step of its direction, of the same size."""
    length = float(np.linalg.norm(step))
    size = float(np.linalg.norm(gravity))
    if length > LARGEST_STEP_RAD:
        step = step * (LARGEST_STEP_RAD / length)
    direction = gravity / size + step
    return np.asarray(size * direction / np.linalg.norm(direction))


# A fit of all rows in another geometry


def fits_better(
    geometry: TurnedGeometry,
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning,
    gains: FloatArray,
    *,
    gains_fixed: bool,
    before_percent: float | None,
) -> bool:
    """Whether a fit of all rows in another geometry has a smaller error than as declared.

    Args:
        geometry: found in a few rows.
        model, conditioning: as declared.
        runs: of the fit, as they were read.
        gains: nameplate, shape (m,).
        gains_fixed: the fit holds them.
        before_percent: relative error of the fit as declared; None where it was refused.
    """
    method = Method.ML
    fixed: FloatArray | None = None
    if gains_fixed:
        method = Method.WLS
        signs = np.ones(len(gains))
        signs[list(geometry.reversed_currents)] = -1.0
        fixed = gains * signs
    corrected_model = geometry.model(model)
    corrected_runs = _corrected(geometry, runs)
    try:
        found = identify(
            corrected_model,
            corrected_runs,
            conditioning,
            method=method,
            fixed_gains=fixed,
            judge=False,
        )
    except IdentificationError:
        return False
    limit = LARGEST_TOTAL_PERCENT
    if before_percent is not None:
        limit = before_percent
    return found.training_error.total < limit


def _corrected(geometry: TurnedGeometry, runs: Iterable[Run]) -> Iterator[Run]:
    for run in runs:
        position_rad = geometry.corrected_positions(run.position_rad)
        yield replace(run, position_rad=position_rad)


# Judgement


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A hypothesis with the errors of its predictions."""

    fit: MotorFit  #: of all rows
    #: of each motor's current on each part, by the fit of the others, sums of squares, shape (m, P)
    left: FloatArray
    current_square: FloatArray  #: sums of squares of the currents likewise, shape (m, P)
    reading: PositionReading | None = None
    gravity: GravityFound | None = None

    @property
    def smallest(self) -> FloatArray:
        """Error below which a current needs no other explanation, shape (m,).

        It is the root of a sum of squares, as `floored_error`.
        """
        size = np.sqrt(self.current_square.sum(axis=1))
        return np.asarray(np.where(size > 0.0, SMALL_ERROR * size, 1.0))

    @property
    def floored_error(self) -> FloatArray:
        """Error of each motor, at least the smallest, shape (m,)."""
        error = np.sqrt(self.left.sum(axis=1))
        return np.asarray(np.maximum(error, self.smallest))

    @property
    def percent(self) -> FloatArray:
        """Error of each motor, of its current [%], shape (m,)."""
        size = self.current_square.sum(axis=1)
        size[size == 0.0] = 1.0
        share = self.left.sum(axis=1) / size
        return np.asarray(100.0 * np.sqrt(share))

    def fall(self, before: Judged) -> float:
        """Fall of the logarithm of the errors from another hypothesis, in sum over the motors."""
        falls = np.log(before.floored_error / self.floored_error)
        return float(np.sum(falls))

    def is_better(self, before: Judged) -> bool:
        """Whether the errors fall by LEAST_FALL, and in the parts alike."""
        if self.fall(before) < LEAST_FALL:
            return False
        # The mean error of a part is added on both sides, so that a part of few rows does not
        # decide.
        smaller_error = np.minimum(before.floored_error, self.floored_error)
        usual = smaller_error[:, None] ** 2 / PARTS
        ratio = (before.left + usual) / (self.left + usual)
        falls = 0.5 * np.sum(np.log(ratio), axis=0)
        std_of_mean = float(np.std(falls, ddof=1)) / np.sqrt(len(falls))
        return bool(np.mean(falls) > LEAST_T * std_of_mean)

    def stands_beside(self, small: Sequence[Judged]) -> bool:
        """Whether a hypothesis is better than all small corrections.

        A turn of gravity stands where none of them is better than it. Gravity that is turned by 15°
        is another explanation of the same size as a zero that is off by 15°. Where the joints
        before this one hardly move, nothing tells the two apart.
        """
        if self.gravity is not None:
            return not any(one.is_better(self) for one in small)
        return all(self.is_better(one) for one in small)

    def contradictions(self, gains: FloatArray) -> float:
        """Number of currents with another sign than the nameplate, by the gains, shape (m,).

        That of a reversed axis counts half: where the axis of the URDF points the other way, both
        are reversed.
        """
        has_other_sign = self.fit.per_unit * gains < 0.0
        count = float(np.count_nonzero(has_other_sign))
        reading = self.reading
        if reading is not None and reading.sign < 0.0 and has_other_sign[reading.axis]:
            count -= 0.5
        return count


def judge_hypothesis(products: Products, start: MotorFit, reference: FloatArray) -> Judged:
    """Fit a hypothesis, and predict each part of the moves from the others.

    Args:
        products: under the hypothesis.
        start: of the fit.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    square = products.square.sum(axis=1)
    rows = products.rows.sum(axis=1)
    fit = improved(square, rows, start, reference, FIT_ROUNDS)
    left = np.zeros(products.rows.shape)
    for part in range(PARTS):
        own = products.square[:, part]
        other_square = square - own
        other_rows = rows - products.rows[:, part]
        fit_of_others = improved(other_square, other_rows, fit, reference, NEXT_ROUNDS)
        left[:, part] = left_over(own, fit_of_others)
    return Judged(fit, left, products.current_square)


# Fit of one hypothesis


@dataclass(frozen=True, slots=True, eq=False)
class MotorFit:
    """Parameters with which all motors' equations hold best."""

    #: s, current per unit of torque [A/Nm or A/N] up to a common factor, shape (m,)
    per_unit: FloatArray
    parameters: FloatArray  #: χ in the same scale, shape (c,)
    weight: FloatArray  #: 1/σ² of each motor's current [1/A²], shape (m,)

    def in_reading(self, reading: PositionReading) -> MotorFit:
        """The fit from which that of a reading begins: friction brakes its reversed motion too."""
        signs = np.ones(len(self.per_unit))
        signs[reading.axis] = reading.sign
        return replace(self, per_unit=self.per_unit * signs)


def first_fit(model: Model, products: Products, reference: FloatArray) -> MotorFit:
    """Begin a fit with the nameplate gains, and the signs with which each motor's friction brakes.

    Args:
        model, products: of the hypothesis.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
    """
    square = products.square.sum(axis=1)
    names = [column.name for column in model.columns]
    friction = [index for index, name in enumerate(names) if FRICTION.match(name)]
    dry = model.dry_friction_columns[list(model.drive_train.joints)]
    signs = np.ones(len(square))
    for motor, own in enumerate(square):
        # The motor's equation alone; its friction along the sign of its velocity
        parameters = _solved(own[:-1, :-1], own[:-1, -1])
        along_motion = own[friction, dry[motor]] @ parameters[friction]
        if along_motion < 0.0:
            signs[motor] = -1.0
    current_square = products.current_square.sum(axis=1)
    current_square = np.where(current_square > 0.0, current_square, 1.0)
    weight = products.rows.sum(axis=1) / current_square
    no_parameters = np.zeros(square.shape[1] - 1)
    return MotorFit(signs * reference, no_parameters, weight)


def improved(
    square: FloatArray, rows: IntArray, start: MotorFit, reference: FloatArray, rounds: int
) -> MotorFit:
    """Fit χ, s and the weights in turn.

    Args:
        square: products of [W | v_i], shape (m, c + 1, c + 1).
        rows: of each motor, shape (m,).
        start: of the iteration; its parameters are not used.
        reference: 1/|g| of the nameplate [A/Nm or A/N], shape (m,).
        rounds: at least one.
    """
    of_columns = square[:, :-1, :-1]
    with_current = square[:, :-1, -1]
    fit = start
    for _ in range(rounds):
        # χ of Σ_i w_i s_i² WᵀW χ = Σ_i w_i s_i Wᵀv_i
        normal = np.einsum("i,iab->ab", fit.weight * fit.per_unit**2, of_columns)
        right = (fit.weight * fit.per_unit) @ with_current
        parameters = _solved(normal, right)
        # s_i = vᵀWχ / ‖Wχ‖², as far as the nameplate allows
        torque_square = (of_columns @ parameters) @ parameters
        mixed = with_current @ parameters
        per_unit = mixed / np.where(torque_square > 0.0, torque_square, 1.0)
        ratio = np.maximum(np.abs(per_unit) / reference, 1e-12)
        common = float(np.exp(np.median(np.log(ratio))))
        limited = np.clip(ratio / common, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
        signs = np.where(per_unit < 0.0, -1.0, 1.0)
        fit = MotorFit(signs * reference * limited, common * parameters, fit.weight)
        left = _floored_left(square, fit)
        fit = replace(fit, weight=np.maximum(rows, 1) / left)
    return fit


def left_over(square: FloatArray, fit: MotorFit) -> FloatArray:
    """What a fit leaves of each motor's current [A²], sums of squares, shape (m,).

    Arguments as for `improved`.
    """
    of_columns = square[:, :-1, :-1]
    with_current = square[:, :-1, -1]
    current_square = square[:, -1, -1]
    # ‖v − s Wχ‖² = ‖v‖² − (2 s vᵀWχ − s² ‖Wχ‖²)
    torque_square = (of_columns @ fit.parameters) @ fit.parameters
    mixed = with_current @ fit.parameters
    explained = 2.0 * fit.per_unit * mixed - fit.per_unit**2 * torque_square
    return np.maximum(current_square - explained, 0.0)


def _floored_left(square: FloatArray, fit: MotorFit) -> FloatArray:
    """The same, at least that of SMALL_ERROR."""
    current_square = square[:, -1, -1]
    left = np.maximum(left_over(square, fit), SMALL_ERROR**2 * current_square)
    left[left == 0.0] = 1.0  # a motor without current
    return left


def _log_error(square: FloatArray, fit: MotorFit) -> float:
    """Logarithm of the motors' errors, in sum; arguments as for `improved`."""
    left = _floored_left(square, fit)
    return 0.5 * float(np.sum(np.log(left)))


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve normal equations with RIDGE in unit columns; those of rounding errors get zero."""
    size = np.sqrt(np.diag(normal))
    is_rounding = size <= SMALLEST_COLUMN * size.max(initial=0.0)
    size[is_rounding] = np.inf
    scaled = normal / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE
    solution = scipy.linalg.solve(scaled, right / size, assume_a="pos")
    return np.asarray(solution / size)


# Products of columns


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """Products of the columns [W | v_i] of each motor, each part of the moves for itself."""

    square: FloatArray  #: shape (m, PARTS, c + 1, c + 1)
    rows: IntArray  #: shape (m, PARTS)

    @property
    def current_square(self) -> FloatArray:
        """Sums of squares of the currents [A²], shape (m, PARTS)."""
        return np.asarray(self.square[:, :, -1, -1])


@dataclass(frozen=True, slots=True, eq=False)
class GravityProducts:
    """Products of the columns [A | G_x | G_y | G_z | v_i] of each motor, by part of the moves."""

    square: FloatArray  #: shape (m, PARTS, c + 3 f + 1, c + 3 f + 1)
    rows: IntArray  #: shape (m, PARTS)
    weighty: IntArray  #: columns of A that gravity changes, shape (f,)

    @property
    def columns(self) -> int:
        """Number c of columns of A."""
        width = int(self.square.shape[-1])
        return width - 1 - 3 * len(self.weighty)

    def along(self, component: int) -> slice:
        """Columns G_k."""
        first = self.columns + component * len(self.weighty)
        return slice(first, first + len(self.weighty))

    def directed(self, gravity_m_s2: FloatArray) -> Products:
        """Products of [W(g) | v_i] under a gravity g, shape (3,)."""
        return Products(self.turned(self.square, gravity_m_s2), self.rows)

    def turned(self, square: FloatArray, gravity_m_s2: FloatArray) -> FloatArray:
        """Products of [W(g) | v_i] from those of [A | G_x | G_y | G_z | v_i].

        Args:
            square: of shape (…, c + 3 f + 1, c + 3 f + 1).
            gravity_m_s2: g, shape (3,).
        """
        *leading, width, _ = square.shape
        last = width - 1
        weighty = self.weighty
        rows_of_weighty = weighty[:, None]
        kept = np.append(np.arange(self.columns), last)
        out = square[..., kept[:, None], kept]
        # Σ_k g_k G_kᵀ [A | G_x | G_y | G_z | v_i]
        heavy = np.zeros((*leading, len(weighty), width))
        for component, size in enumerate(gravity_m_s2):
            heavy += size * square[..., self.along(component), :]
        with_kept = heavy[..., kept]
        out[..., weighty, :] += with_kept
        out[..., :, weighty] += np.swapaxes(with_kept, -1, -2)
        for component, size in enumerate(gravity_m_s2):
            with_component = heavy[..., self.along(component)]
            out[..., rows_of_weighty, weighty] += size * with_component
        return out

    def turn(self, square: FloatArray, gravity_m_s2: FloatArray, fit: MotorFit) -> FloatArray:
        """Step of gravity's direction by Gauss-Newton, χ fitted with it [rad], shape (3,).

        Args:
            square: products of [A | G_x | G_y | G_z | v_i], shape (m, c + 3 f + 1, c + 3 f + 1).
            gravity_m_s2: at which it is taken.
            fit: for this gravity.
        """
        width = square.shape[-1]
        last = width - 1
        count = self.columns
        size = float(np.linalg.norm(gravity_m_s2))
        # Two directions across gravity, (3, 2)
        sideways = scipy.linalg.null_space(gravity_m_s2[None])
        # Columns [W(g) | derivatives to the two | v_i] from [A | G_x | G_y | G_z | v_i]
        basis = np.zeros((width, count + 3))
        basis[:count, :count] = np.eye(count)
        basis[last, -1] = 1.0
        every_row = np.arange(width)
        moments = size * fit.parameters[self.weighty]
        for component in range(3):
            rows = every_row[self.along(component)]
            basis[rows, self.weighty] = gravity_m_s2[component]
            basis[rows, count : count + 2] = moments[:, None] * sideways[component]
        # Σ_i w_i s_i² of the columns' products, Σ_i w_i s_i of those with the current
        normal = np.einsum("i,iab->ab", fit.weight * fit.per_unit**2, square)
        with_current = (fit.weight * fit.per_unit) @ square[:, :, -1]
        normal[:, -1] = with_current
        normal[-1, :] = with_current
        projected = basis.T @ normal @ basis
        solution = _solved(projected[:-1, :-1], projected[:-1, -1])
        return np.asarray(sideways @ solution[-2:])


def gravity_products(
    model: Model, instants: Sequence[Instants], part_count: int = PARTS
) -> GravityProducts:
    """Products for any direction of gravity, of runs with any payloads.

    Args:
        model: the declared model, its gravity apart.
        instants: of all runs, of the axes of the model.
        part_count: number of parts of the moves.

    Raises:
        ModelError: the loops of a closed chain cannot be closed.
    """
    mountings = _mountings(instants)
    weightless = with_gravity(model, np.zeros(3))
    pulled = [with_gravity(model, unit) for unit in np.eye(3)]
    body_numbers = np.arange(len(mountings))
    payload_columns = len(model.columns) + len(LINK_PARAMETERS) * body_numbers
    first_of_body = np.append(model.link_columns[:, 0], payload_columns)
    weighty = (first_of_body[:, None] + np.array(WEIGHTY)).ravel()

    def columns_of(one: Instants) -> FloatArray:
        rest = at_rest(one.motion.position_rad)
        columns = [_motor_columns(weightless, one, one.motion, mountings)]
        for in_unit_gravity in pulled:
            of_weight = _motor_columns(in_unit_gravity, one, rest, mountings)
            columns.append(of_weight[:, weighty])
        return np.concatenate(columns, axis=1)

    square, rows = _summed_products(instants, part_count, columns_of)
    return GravityProducts(square, rows, weighty)


def products_of_reading(
    model: Model, instants: Sequence[Instants], reading: PositionReading, part_count: int = PARTS
) -> Products:
    """Products where the position of an axis is read otherwise; arguments as before.

    Raises:
        ModelError: the loops of a closed chain cannot be closed.
    """
    mountings = _mountings(instants)

    def columns_of(one: Instants) -> FloatArray:
        return _motor_columns(model, one, reading.motion(one.motion), mountings)

    square, rows = _summed_products(instants, part_count, columns_of)
    return Products(square, rows)


def _summed_products(
    instants: Sequence[Instants], part_count: int, columns_of: Callable[[Instants], FloatArray]
) -> tuple[FloatArray, IntArray]:
    """Products of the columns and the current of each motor over all runs, by part; row counts.

    Args:
        instants: of all runs.
        part_count: number of parts of the moves.
        columns_of: columns of each motor in a run, shape (m, c, k).
    """
    squares = list[FloatArray]()
    rows = list[IntArray]()
    for one, parts in zip(instants, _parts(instants, part_count), strict=True):
        columns = np.concatenate((columns_of(one), one.current_a[:, None]), axis=1)
        square, counted = _products(columns, one, parts, part_count)
        squares.append(square)
        rows.append(counted)
    return np.sum(squares, axis=0), np.sum(rows, axis=0)


def _parts(instants: Sequence[Instants], part_count: int) -> list[IntArray]:
    """Which part each row of each run is in; -1 for a row that does not count.

    Moves with rows that count are dealt out in turn over all runs.
    """
    dealt = 0
    parts = list[IntArray]()
    for one in instants:
        of_rows = np.full(len(one.move), -1)
        counts = one.use.any(axis=0)
        for move in np.unique(one.move[counts]):
            of_rows[one.move == move] = dealt % part_count
            dealt += 1
        parts.append(of_rows)
    return parts


def _mountings(instants: Sequence[Instants]) -> list[str]:
    return sorted({one.mounting for one in instants if one.mounting is not None})


def _motor_columns(
    model: Model, one: Instants, motion: Motion, mountings: Sequence[str]
) -> FloatArray:
    """Columns (T W)_i of the standard parameters, then of each mounting's body, (m, c, k)."""
    standard = model.regressor(motion, loaded=one.mounting is not None)
    joints, _, samples = standard.shape
    body_size = len(LINK_PARAMETERS)
    bodies = np.zeros((joints, body_size * len(mountings), samples))
    if one.mounting is not None:
        first = body_size * mountings.index(one.mounting)
        bodies[:, first : first + body_size] = standard[:, model.flange]
    columns = np.concatenate((standard, bodies), axis=1)
    # Σ_j T_ij W_jck
    return np.asarray(np.tensordot(model.drive_train.to_motor, columns, axes=1))


def _products(
    columns: FloatArray, one: Instants, parts: IntArray, part_count: int
) -> tuple[FloatArray, IntArray]:
    """Products of each motor's columns, shape (m, c, k), over its rows of each part; row counts."""
    count, width, _ = columns.shape
    square = np.zeros((count, part_count, width, width))
    rows = np.zeros((count, part_count), dtype=np.int64)
    for motor, of_motor in enumerate(columns):
        loading = np.flatnonzero(of_motor.any(axis=1))  # a wrist carries few links
        for part in range(part_count):
            used = one.use[motor] & (parts == part)
            chosen = of_motor[np.ix_(loading, used)]
            square[motor, part][np.ix_(loading, loading)] = chosen @ chosen.T
            rows[motor, part] = np.count_nonzero(used)
    return square, rows
