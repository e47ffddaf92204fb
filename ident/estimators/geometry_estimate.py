"""Geometry of a robot with more encoders than degrees of freedom, from its positions alone.

The pose that fits the m encoders best leaves a misfit of m − d numbers a sample, e(θ) in the
directions in which it can be. Where the description is right, it is the encoders' noise. θ are the
changes of zeros, lengths and base places (`ident.model.geometry`), and a delay of each encoder. The
whole of them is estimated by Gauss-Newton; linearised around that estimate, e ≈ J θ − y, the misfit
of every choice of few numbers is a small linear problem. A choice is an explanation where it leaves

- no more than the whole of them does (F test), and
- no more than the encoders' own noise, which counts and differences from sample to sample show.

The second is absolute. Arms that bend leave a misfit that depends on the pose, and so does every
zero and length: some three of them always take most of it, but not down to the noise. The
explanation with the fewest numbers is taken, one before two before three. Numbers that are not in
it stay as they are described. More than three wrong numbers look like another cause, such as arms
that bend, and then nothing is corrected.

Positions are used as they were recorded: a low-pass bends a closed loop, and the encoders' noise is
that of their counts. Its correlation is estimated (`ident.estimators.encoder_noise`), and all rows
are made white by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import scipy  # loads its modules when they are first used

from ident.arrays import BoolArray, FloatArray
from ident.data.run import Run
from ident.estimators.encoder_noise import MisfitNoise, RunDirections, estimate_noise
from ident.model.closed_chain import joints_by_free_ones, positions, reach_near, solve_qr
from ident.model.closures import loops
from ident.model.geometry import (
    GeometryChange,
    GeometryKind,
    GeometryParameter,
    base_places,
    encoder_delays,
    geometry_parameters,
    unit_of,
    with_geometry,
)
from ident.model.model import Model
from ident.model.robot import JointKind, Robot

SPACING_S = 0.02  #: Least time between two positions that are used
MOST_ROWS = 600  #: Misfits of all runs together; σ of a zero is then some 10⁻⁶ rad
LEAST_POSITIONS = 50  #: Fewer positions judge no geometry
WINDOW_S = 0.02  #: Before and after a position, for the polynomial of its motion
LEAST_WINDOW = 3  #: Samples on either side
DEGREE = 4  #: Of that polynomial; at 3 Hz it is right to 1e-4 of the amplitude
SMALLEST_COUNT_RAD = 1e-10  #: Smaller steps between two positions are rounding
MOST_CAUSES = 3  #: Numbers of an explanation
MOST_TURNS = 3  #: Estimates of the best choice of so many numbers, until it stays the best
#: Change of a length from which the derivative of the closures is taken [of the robot's size]
STEP = 1e-4
ITERATIONS = 8
SETTLED = 1e-10  #: Change at which the iteration ends [rad, or of the robot's size]
#: Change of all misfits together at which that of all numbers ends [σ of one misfit]
SETTLED_SIGMAS = 0.1
SMALLEST_SINGULAR = 1e-9  #: Relative to the largest: rounding
LARGEST_STD = 1e-2
"""Largest σ of a direction of zeros and lengths that can be seen: half a degree.

In rad, or of the robot's size.
"""
TESTED_STD = 1e-3
"""Directions of all numbers together with a larger σ test no explanation: they would be estimated
so far from the truth that a linear problem around them is none of the truth.
"""
#: That the true explanation is refused, and that noise alone is taken for a wrong description
PROBABILITY = 1e-4
SMALLEST_MISFIT = 2e-5
"""Misfit above the noise [rad, or of the robot's size] below which nothing is said:
one twenty times larger moves a gain by 7 to 9 of its σ, so this one by less than half of one.
"""
TOLERATED_MISFIT = 1e-5
"""Misfit above the known noise that an explanation may leave, half of what is not reported: slow
noise of an encoder, in which neighbouring samples hardly differ, is not among the known noise.
"""
#: The same as a share of the misfit: of a small one, some three numbers take most by chance
TOLERATED_SHARE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Some recorded positions of one run, with what is around them in time."""

    time_s: FloatArray  #: of each, shape (k,)
    position_rad: FloatArray  #: of the axes, as recorded, shape (k, m)
    before_rad: FloatArray  #: one sample earlier, shape (k, m)
    after_rad: FloatArray  #: one sample later, shape (k, m)
    interval_s: float  #: between two samples of the run
    #: Coefficients of t, t², … of the motion around each position [rad/sⁿ], shape (k, m, DEGREE).
    motion: FloatArray
    count_rad: FloatArray  #: smallest step of each axis, shape (m,)

    def every(self, stride: int) -> Positions:
        """Return every so many positions."""
        chosen = slice(None, None, stride)
        return replace(
            self,
            time_s=self.time_s[chosen],
            position_rad=self.position_rad[chosen],
            before_rad=self.before_rad[chosen],
            after_rad=self.after_rad[chosen],
            motion=self.motion[chosen],
        )


@dataclass(frozen=True, slots=True)
class GeometryEstimate:
    """A number of the description that is wrong, or the delay of an encoder."""

    parameter: GeometryParameter
    change: float  #: what has to be added to it [rad or m]; of a delay, the delay [s]
    std: float  #: σ of the change


@dataclass(frozen=True, slots=True, eq=False)
class GeometryFinding:
    """What the encoders say of the geometry."""

    #: Root mean square of what is left of the encoders' positions beside the pose that fits them
    #: best, a direction [rad, or of the robot's size], with the described geometry.
    misfit: float
    #: the same with the causes; where there are none, with all zeros and lengths estimated
    misfit_left: float
    #: the same of the encoders' noise, by counts and by differences from sample to sample
    noise: float
    is_significant: bool  #: the description leaves more misfit than noise does
    #: the explanation with the fewest numbers; empty without one
    causes: tuple[GeometryEstimate, ...]
    covariance: FloatArray  #: of their changes, shape (p, p)
    #: Other explanations with as many numbers that these positions cannot distinguish from it.
    alternatives: tuple[tuple[GeometryEstimate, ...], ...]
    #: directions of zeros and lengths that no position shows, in words
    unobservable: tuple[str, ...]

    @property
    def corrections(self) -> tuple[GeometryEstimate, ...]:
        """Causes that can be corrected in the description: none where an encoder may be late."""
        for explanation in (self.causes, *self.alternatives):
            for cause in explanation:
                if cause.parameter.kind is GeometryKind.DELAY:
                    return ()
        return self.causes

    @property
    def changes(self) -> tuple[GeometryChange, ...]:
        """What has to be added to the description; empty without an explanation."""
        return tuple(GeometryChange(one.parameter, one.change) for one in self.corrections)


def thinned(run: Run) -> Positions:
    """Choose positions that are SPACING_S apart, valid on every axis and with what is around."""
    position_rad = np.asarray(run.position_rad, dtype=np.float64)
    time_s = np.asarray(run.time_s, dtype=np.float64)
    samples, axes = position_rad.shape
    interval_s = 1.0 / run.rate_hz
    every = max(1, round(SPACING_S * run.rate_hz))
    half = max(LEAST_WINDOW, round(WINDOW_S * run.rate_hz))
    usable: BoolArray = np.ones(samples, dtype=np.bool_)
    if run.valid is not None:
        usable = np.asarray(np.all(run.valid, axis=1))
    is_usable_around = _all_around(usable, half)
    chosen = np.arange(half, samples - half, every)
    chosen = chosen[is_usable_around[chosen]]
    motion = np.zeros((len(chosen), axes, DEGREE))
    offsets = np.arange(-half, half + 1)
    weights = _polynomial_weights(np.asarray(offsets * interval_s, dtype=np.float64))
    for offset, weight in zip(offsets, weights, strict=True):
        moved_rad = position_rad[chosen + offset]
        motion += moved_rad[:, :, None] * weight
    counts = [_smallest_step(position_rad[usable, axis]) for axis in range(axes)]
    return Positions(
        time_s=time_s[chosen],
        position_rad=position_rad[chosen],
        before_rad=position_rad[chosen - 1],
        after_rad=position_rad[chosen + 1],
        interval_s=interval_s,
        motion=motion,
        count_rad=np.array(counts),
    )


def _polynomial_weights(time_s: FloatArray) -> FloatArray:
    """Weight of each sample in the coefficients of t, t², … by least squares, (w, DEGREE)."""
    powers = np.vander(time_s, DEGREE + 1, increasing=True)
    fitting = np.linalg.pinv(powers)
    return np.asarray(fitting[1:].T)


def _all_around(usable: BoolArray, half: int) -> BoolArray:
    """Whether all samples within half a window of each are usable, shape (k,)."""
    count = len(usable)
    samples = np.arange(count)
    unusable_before = np.concatenate(([0], np.cumsum(~usable)))
    first = np.maximum(samples - half, 0)
    end = np.minimum(samples + half + 1, count)
    return np.asarray(unusable_before[end] == unusable_before[first])


def _smallest_step(values: FloatArray) -> float:
    """Smallest difference between two values that is not rounding; zero without any."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > SMALLEST_COUNT_RAD]
    if not len(steps):
        return 0.0
    return float(steps.min())


def estimate_geometry(model: Model, runs: Sequence[Positions]) -> GeometryFinding | None:
    """Compare the description with the encoders: find the fewest numbers of it that are wrong.

    Args:
        model: of the description.
        runs: recorded positions.

    Returns:
        None for a robot without redundant encoders, and where there are too few positions.

    Raises:
        ModelError: the loops cannot be closed, or the encoders contradict each other so much that
            no pose fits them.
    """
    if not model.is_redundant:
        return None
    count = sum(len(one.time_s) for one in runs)
    if count < LEAST_POSITIONS:
        return None
    directions = model.robot.axis_count - model.assembly.mobility
    stride = -(-count * directions // MOST_ROWS)  # rounded up
    thinner = [run.every(stride) for run in runs if len(run.time_s)]
    problem = _Problem.of(model, thinner)
    as_described = np.zeros(len(problem.parameters))
    described_misfit = problem.misfit(as_described)
    misfit = float(np.sqrt(np.mean(described_misfit**2)))
    square = float(described_misfit @ described_misfit)
    noise_std = problem.noise_std(as_described)
    is_significant = problem.excess(square, 0, noise_std) > SMALLEST_MISFIT
    explanations: list[tuple[int, ...]] = []
    causes: tuple[int, ...] = ()
    left = misfit
    if is_significant:
        explanations, fitted = _explained(problem, _whole(problem))
        if explanations:
            causes = explanations[0]
            left_square = fitted.misfit_square_of(causes)
        else:
            left_square = fitted.square_of_description()
        left = float(np.sqrt(left_square / problem.rows))
    else:
        fitted = _with_noise(problem, as_described)
    estimates, covariance = _estimates(fitted, causes)
    alternatives: list[tuple[GeometryEstimate, ...]] = []
    for other in explanations[1:]:
        other_estimates, _ = _estimates(fitted, other)
        alternatives.append(other_estimates)
    return GeometryFinding(
        misfit=misfit,
        misfit_left=left,
        noise=fitted.noise_std,
        is_significant=is_significant,
        causes=estimates,
        covariance=covariance,
        alternatives=tuple(alternatives),
        unobservable=fitted.unobservable(),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Recorded positions, and the poses with the described geometry from which others are near."""

    model: Model
    parameters: tuple[GeometryParameter, ...]  #: zeros and lengths, base places, delays
    #: of each: a radian, the robot's size [m], or the time for a radian [s], shape (p,)
    unit: FloatArray
    runs: tuple[Positions, ...]
    axis_unit: FloatArray  #: a radian, or the robot's size [m], of each axis, shape (m,)
    near_rad: FloatArray  #: of all joints, shape (k, n)
    basis: FloatArray  #: B, orthonormal: directions in which a misfit can be, shape (k, m, m − d)

    @classmethod
    def of(cls, model: Model, runs: Sequence[Positions]) -> _Problem:
        """Find the poses that fit the encoders best with the described geometry."""
        robot = model.robot
        kinds = [joint.kind for joint in robot.axes]
        is_revolute = np.array([kind is JointKind.REVOLUTE for kind in kinds])
        axis_unit = np.where(is_revolute, 1.0, model.assembly.size_m)
        of_description = (*geometry_parameters(robot), *base_places(robot))
        units = [unit_of(model, parameter) for parameter in of_description]
        speed = _speeds(runs) / axis_unit
        mean_speed = np.sqrt(np.mean(speed**2, axis=0))
        units += [1.0 / max(float(one), SMALLEST_SINGULAR) for one in mean_speed]
        axes_rad = np.concatenate([run.position_rad for run in runs])
        near_rad = positions(robot, model.assembly, axes_rad)
        basis = _misfit_directions(model, near_rad, axis_unit)
        return cls(
            model=model,
            parameters=(*of_description, *encoder_delays(robot)),
            unit=np.array(units),
            runs=tuple(runs),
            axis_unit=axis_unit,
            near_rad=near_rad,
            basis=basis,
        )

    @property
    def rows(self) -> int:
        """Independent numbers in all misfits, k (m − d)."""
        samples, _, directions = self.basis.shape
        return int(samples * directions)

    @property
    def described(self) -> tuple[int, ...]:
        """Indices of zeros and lengths."""
        return tuple(range(len(geometry_parameters(self.model.robot))))

    @property
    def directions(self) -> list[RunDirections]:
        """When and in which directions each run shows a misfit."""
        directions: list[RunDirections] = []
        first = 0
        for run in self.runs:
            last = first + len(run.time_s)
            directions.append(RunDirections(run.time_s, self.basis[first:last]))
            first = last
        return directions

    def misfit(self, changes: FloatArray, offset: int = 0) -> FloatArray:
        """e with changes of all parameters in their units, shape (k (m − d),).

        ``offset`` -1 or 1 is for the samples before or after.
        """
        axes_rad = self._recorded(changes, offset)
        position_rad = self._closed(self._changed(changes), axes_rad)
        return self._apart(axes_rad, position_rad)

    def _recorded(self, changes: FloatArray, offset: int = 0) -> FloatArray:
        """Positions of the axes, those of late encoders at the time of the others, shape (k, m)."""
        axis_count = self.model.robot.axis_count
        delays_s = (changes * self.unit)[-axis_count:]
        parts: list[FloatArray] = []
        for run in self.runs:
            match offset:
                case -1:
                    recorded_rad = run.before_rad
                case 1:
                    recorded_rad = run.after_rad
                case _:
                    recorded_rad = run.position_rad
            at_s = np.full(axis_count, offset * run.interval_s)
            here_rad = _moved(run.motion, at_s)
            undelayed_rad = _moved(run.motion, at_s + delays_s)
            parts.append(recorded_rad + undelayed_rad - here_rad)
        return np.concatenate(parts)

    def _changed(self, changes: FloatArray) -> Robot:
        """Robot with changes of all parameters in their units."""
        described: list[GeometryChange] = []
        for parameter, change in zip(self.parameters, changes * self.unit, strict=True):
            if parameter.kind is not GeometryKind.DELAY:
                described.append(GeometryChange(parameter, float(change)))
        return with_geometry(self.model.robot, described)

    def _closed(self, robot: Robot, axes_rad: FloatArray) -> FloatArray:
        """Poses of another geometry that fit the encoders best, shape (k, n)."""
        return reach_near(robot, self.model.assembly, self.near_rad, axes_rad)

    def _apart(self, axes_rad: FloatArray, position_rad: FloatArray) -> FloatArray:
        """e of poses, shape (k (m − d),)."""
        motors = list(self.model.robot.axis_joints)
        apart = axes_rad - position_rad[:, motors]
        return self._in_directions(apart)

    def _in_directions(self, apart: FloatArray) -> FloatArray:
        """Differences of the axes along the directions of a misfit, shape (k (m − d),).

        Args:
            apart: of each axis [rad or m], shape (k, m).
        """
        # e_kr = Σ_m B_kmr a_km
        misfit = np.einsum("kmr,km->kr", self.basis, apart / self.axis_unit)
        return np.asarray(misfit.ravel())

    def linearised(
        self, changes: FloatArray, chosen: Sequence[int]
    ) -> tuple[FloatArray, FloatArray]:
        """e and its derivatives to some parameters, shapes (k (m − d),) and (k (m − d), p).

        The parameters are in their units. With P = I − A (AᵀA)⁻¹ Aᵀ, a zero moves e by P e_j, a
        delay by P e_j q̇_j, and a length or place by −P times what the motors' joints move where x
        stays: J_d dq_d = −∂φ/∂θ. φ is linear in lengths and places, so that a difference of it is
        exact.
        """
        robot = self._changed(changes)
        assembly = self.model.assembly
        motors = list(robot.axis_joints)
        names = [joint.name for joint in robot.axes]
        rest = list(assembly.dependent)
        axes_rad = self._recorded(changes)
        position_rad = self._closed(robot, axes_rad)
        closing = loops(robot, position_rad, assembly.size_m)
        to_joints, q, r = joints_by_free_ones(assembly, closing.jacobian)
        # P = I − Q Qᵀ, Q an orthonormal basis of the motors' possible motion
        onto = np.linalg.qr(to_joints[:, motors]).Q
        hidden = np.eye(len(motors)) - onto @ np.swapaxes(onto, 1, 2)
        speed = _speeds(self.runs)
        columns: list[FloatArray] = []
        for index in chosen:
            parameter = self.parameters[index]
            unit = float(self.unit[index])
            match parameter.kind:
                case GeometryKind.ZERO:
                    axis = names.index(parameter.joint)
                    column = hidden[:, :, axis]
                case GeometryKind.DELAY:
                    axis = names.index(parameter.joint)
                    column = hidden[:, :, axis] * speed[:, [axis]]
                case _:
                    step = STEP * unit
                    longer = with_geometry(robot, (GeometryChange(parameter, step),))
                    longer_closing = loops(longer, position_rad, assembly.size_m)
                    gap = longer_closing.residual - closing.residual
                    moved = np.zeros(position_rad.shape)
                    moved[:, rest] = -solve_qr(q, r, gap)
                    # −P dq_d of the motors' joints
                    column = -np.einsum("kij,kj->ki", hidden, moved[:, motors]) / step
            columns.append(unit * self._in_directions(column))
        return self._apart(axes_rad, position_rad), np.stack(columns, axis=1)

    def noise_std(self, changes: FloatArray) -> float:
        """σ of a misfit by what is known of the encoders, the larger of two.

        One is by the second differences of e from sample to sample, which a smooth motion of what
        is left does not reach; the other is that of rounding to counts, which an axis at rest shows
        in no difference.
        """
        earlier = self.misfit(changes, -1)
        now = self.misfit(changes)
        later = self.misfit(changes, 1)
        # White noise of variance σ² has second differences of variance 6 σ².
        differences = earlier - 2.0 * now + later
        variance_by_differences = float(np.mean(differences**2)) / 6.0
        # Rounding to counts c has variance c²/12; each axis has its share of a direction.
        counts = [np.tile(run.count_rad, (len(run.time_s), 1)) for run in self.runs]
        scaled_counts = np.concatenate(counts) / self.axis_unit
        share = np.sum(self.basis**2, axis=2) / self.basis.shape[2]
        count_squares = np.sum(share * scaled_counts**2, axis=1)
        variance_by_counts = float(np.mean(count_squares)) / 12.0
        return float(np.sqrt(max(variance_by_differences, variance_by_counts)))

    def excess(self, square: float, count: int, noise_std: float) -> float:
        """Root mean square of a misfit beyond the known noise [rad, or of the robot's size].

        Args:
            square: Σe².
            count: of the numbers that were estimated.
            noise_std: of a misfit; each sample gives one difference, so that it is known as well as
                the misfit is.
        """
        freedom = self.rows - count
        limit = float(scipy.stats.f.isf(PROBABILITY, freedom, self.rows))
        noise_square = limit * noise_std**2
        excess_square = square / freedom - noise_square
        return float(np.sqrt(max(excess_square, 0.0)))


def _speeds(runs: Sequence[Positions]) -> FloatArray:
    """Speed of the axes at each position of all runs [rad/s or m/s], shape (k, m)."""
    return np.concatenate([run.motion[:, :, 0] for run in runs])


def _moved(motion: FloatArray, time_s: FloatArray) -> FloatArray:
    """Motion from a position over a time of each axis, shape (m,): shape (k, m)."""
    exponents = np.arange(1, DEGREE + 1)
    powers = time_s[:, None] ** exponents
    # Σ_n c_kmn t_mⁿ
    return np.asarray(np.einsum("kmn,mn->km", motion, powers))


def _misfit_directions(model: Model, position_rad: FloatArray, axis_unit: FloatArray) -> FloatArray:
    """Orthonormal directions of the axes in which no motion goes, shape (k, m, m − d).

    They are in the units of the axes.
    """
    closing = loops(model.robot, position_rad, model.assembly.size_m)
    to_joints, _, _ = joints_by_free_ones(model.assembly, closing.jacobian)
    to_motors = to_joints[:, list(model.robot.axis_joints)]
    mobility = model.assembly.mobility
    complete = np.linalg.qr(to_motors, mode="complete").Q
    hidden = complete[:, :, mobility:]
    return np.asarray(np.linalg.qr(hidden / axis_unit[:, None]).Q)


@dataclass(frozen=True, slots=True, eq=False)
class _Visible:
    """Directions of some parameters that the positions show."""

    ways: FloatArray  #: right singular vectors of their white columns, a row each, shape (p, p)
    seen: int  #: how many of them these positions show

    @classmethod
    def of(cls, columns: FloatArray, variance: float, largest_std: float) -> _Visible:
        """Those that are known to some σ."""
        _, singular, ways = np.linalg.svd(columns, full_matrices=False)
        is_real = singular > SMALLEST_SINGULAR * singular[0]
        is_known = np.sqrt(variance) < largest_std * singular
        seen = int(np.sum(is_real & is_known))
        return cls(ways, seen)

    @property
    def seen_ways(self) -> FloatArray:
        """Those that these positions show, a column each, shape (p, seen)."""
        return self.ways[: self.seen].T

    def estimate(self, columns: FloatArray, right: FloatArray) -> FloatArray:
        """Least squares of what is seen; the rest stays as it is described."""
        ways = self.seen_ways
        amounts = np.linalg.lstsq(columns @ ways, right, rcond=None)[0]
        return np.asarray(ways @ amounts)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """e ≈ J θ − y around an estimate, reduced to triangles, and the noise of all numbers."""

    problem: _Problem
    jacobian: FloatArray  #: J, shape (k (m − d), p)
    right: FloatArray  #: y, shape (k (m − d),)
    #: correlation by which the rows were made white; None before it is known
    noise: MisfitNoise | None
    noise_std: float  #: of a misfit, by what is known of the encoders
    triangle: FloatArray  #: R of the white [J | y], shape (p + 1, p + 1)
    misfit_triangle: FloatArray  #: R of [J | y], shape (p + 1, p + 1)
    visible: _Visible  #: of all parameters
    variance: FloatArray  #: σ² of a white row, shape ()
    whole_square: float  #: Σ of the white e² with all that is seen estimated

    @classmethod
    def at(cls, problem: _Problem, changes: FloatArray, noise_std: float) -> _Linearised:
        """Linearise around changes of all parameters in their units, by rows as they are."""
        every = range(len(problem.parameters))
        misfit, jacobian = problem.linearised(changes, every)
        right = jacobian @ changes - misfit
        return cls.of(problem, jacobian, right, None, noise_std)

    @classmethod
    def of(
        cls,
        problem: _Problem,
        jacobian: FloatArray,
        right: FloatArray,
        noise: MisfitNoise | None,
        noise_std: float,
    ) -> _Linearised:
        """Reduce a linear problem."""
        rows = np.column_stack((jacobian, right))
        white = rows
        if noise is not None:
            white = noise.white(rows)
        triangle = np.asarray(np.linalg.qr(white, mode="r"))
        columns = triangle[:, :-1]
        white_right = triangle[:, -1]
        variance = 0.0
        visible = _Visible.of(columns, variance, TESTED_STD)
        square = 0.0
        while True:
            left = white_right - columns @ visible.estimate(columns, white_right)
            square = float(left @ left)
            freedom = max(problem.rows - visible.seen, 1)
            variance = square / freedom
            new = _Visible.of(columns, variance, TESTED_STD)
            if new.seen >= visible.seen:
                break
            visible = new
        return cls(
            problem=problem,
            jacobian=jacobian,
            right=right,
            noise=noise,
            noise_std=noise_std,
            triangle=triangle,
            misfit_triangle=np.asarray(np.linalg.qr(rows, mode="r")),
            visible=visible,
            variance=np.asarray(variance),
            whole_square=square,
        )

    def moved_to(self, changes: FloatArray) -> _Linearised:
        """Take the misfit of other changes, with the derivatives from here.

        They differ by the size of the changes.
        """
        misfit = self.problem.misfit(changes)
        right = self.jacobian @ changes - misfit
        return _Linearised.of(self.problem, self.jacobian, right, self.noise, self.noise_std)

    @property
    def _columns(self) -> FloatArray:
        return self.triangle[:, :-1]

    @property
    def _right(self) -> FloatArray:
        return self.triangle[:, -1]

    @cached_property
    def candidates(self) -> tuple[int, ...]:
        """Indices of the parameters that alone change a misfit."""
        length = np.linalg.norm(self._columns, axis=0)
        is_known = np.sqrt(self.variance) < TESTED_STD * length
        return tuple(np.flatnonzero(is_known).tolist())

    def whole(self) -> FloatArray:
        """All changes as far as they are seen, in their units."""
        return self.visible.estimate(self._columns, self._right)

    def solution(self, chosen: Sequence[int]) -> FloatArray:
        """The chosen changes that leave the least white misfit, in their units."""
        columns = self._columns[:, list(chosen)]
        return np.asarray(np.linalg.lstsq(columns, self._right, rcond=None)[0])

    def square_of(self, chosen: Sequence[int]) -> float:
        """Σ of the white e² that is left when only these numbers change."""
        left = self._right
        if chosen:
            columns = self._columns[:, list(chosen)]
            left = left - columns @ self.solution(chosen)
        return float(left @ left)

    def misfit_square_of(self, chosen: Sequence[int]) -> float:
        """Σe² that is left when only these numbers change."""
        left = self.misfit_triangle[:, -1]
        if chosen:
            columns = self.misfit_triangle[:, list(chosen)]
            left = left - columns @ self.solution(chosen)
        return float(left @ left)

    def square_of_description(self) -> float:
        """Σe² that is left when all zeros and lengths change."""
        columns = self.misfit_triangle[:, list(self.problem.described)]
        right = self.misfit_triangle[:, -1]
        solution = np.linalg.lstsq(columns, right, rcond=SMALLEST_SINGULAR)[0]
        left = right - columns @ solution
        return float(left @ left)

    def explains(self, chosen: Sequence[int]) -> bool:
        """Whether these numbers alone leave no more than all that is seen, and than noise."""
        seen = self.visible.seen
        other_count = max(seen - len(chosen), 1)
        independent: float = self.problem.rows
        if self.noise is not None:
            independent = self.noise.effective
        freedom = max(independent - seen, 1.0)
        limit = float(scipy.stats.f.isf(PROBABILITY, other_count, freedom))
        # F test: the mean square that the other numbers would take
        taken_by_others = (self.square_of(chosen) - self.whole_square) / other_count
        if taken_by_others > limit * self.variance:
            return False
        square = self.misfit_square_of(chosen)
        excess = self.problem.excess(square, len(chosen), self.noise_std)
        described_square = self.misfit_square_of(())
        described = float(np.sqrt(described_square / self.problem.rows))
        return excess <= min(TOLERATED_MISFIT, TOLERATED_SHARE * described)

    def covariance(self, chosen: Sequence[int]) -> FloatArray:
        """Covariance of the chosen changes, in their units."""
        columns = self.triangle[:, list(chosen)]
        upper = np.linalg.qr(columns, mode="r")
        inverse = np.linalg.inv(upper)
        return np.asarray(self.variance * (inverse @ inverse.T))

    def unobservable(self) -> tuple[str, ...]:
        """Directions of zeros and lengths that the positions do not show, by the numbers with the
        largest part.
        """
        columns = self._columns[:, list(self.problem.described)]
        visible = _Visible.of(columns, float(self.variance), LARGEST_STD)
        hidden_ways = visible.ways[visible.seen :]
        return tuple(self._direction(way) for way in hidden_ways)

    def _direction(self, way: FloatArray) -> str:
        least_share = 0.1 * np.abs(way).max()
        described = self.problem.parameters[: len(way)]
        parts: list[str] = []
        for share, parameter in zip(way, described, strict=True):
            if abs(share) > least_share:
                parts.append(f"{share:+.2f} {parameter.name}")
        return ", ".join(parts)


def _whole(problem: _Problem) -> _Linearised:
    """Linearise around the estimate of all numbers; directions that are not seen stay."""
    as_described = np.zeros(len(problem.parameters))
    start = _Linearised.at(problem, as_described, 0.0)
    near = _settled(start, as_described)
    fitted = _with_noise(problem, near.whole())
    return _settled(fitted, fitted.whole())


def _with_noise(problem: _Problem, changes: FloatArray) -> _Linearised:
    """Linearise near an estimate, with the noise that is left there."""
    noise_std = problem.noise_std(changes)
    fitted = _Linearised.at(problem, changes, noise_std)
    seen_jacobian = fitted.jacobian @ fitted.visible.seen_ways
    noise = estimate_noise(problem.directions, seen_jacobian, fitted.right)
    return _Linearised.of(problem, fitted.jacobian, fitted.right, noise, noise_std)


def _settled(start: _Linearised, changes: FloatArray) -> _Linearised:
    """Estimate all numbers by Gauss-Newton, with the derivatives where it starts."""
    fitted = start
    for _ in range(ITERATIONS):
        new = fitted.whole()
        columns = fitted.triangle[:, :-1]
        misfit_step = float(np.linalg.norm(columns @ (new - changes)))
        changes = new
        fitted = fitted.moved_to(changes)
        row_std = np.sqrt(float(fitted.variance))
        if misfit_step < SETTLED + SETTLED_SIGMAS * row_std:
            break
    return fitted


def _explained(problem: _Problem, start: _Linearised) -> tuple[list[tuple[int, ...]], _Linearised]:
    """Choices of the fewest numbers that explain the misfit, the best first.

    The problem that is returned is linearised around the best of them.
    """
    for size in range(1, MOST_CAUSES + 1):
        fitted = start
        best: tuple[int, ...] = ()
        # What is best is known after it was estimated itself: all numbers together are elsewhere.
        for _ in range(MOST_TURNS):
            choices = combinations(fitted.candidates, size)
            new_best = min(choices, key=fitted.square_of, default=best)
            if new_best == best:
                break
            best = new_best
            changes = _refined(problem, fitted, best)
            fitted = start.moved_to(changes)
        if best and fitted.explains(best):
            others: list[tuple[int, ...]] = []
            for choice in combinations(fitted.candidates, size):
                if choice != best and fitted.explains(choice):
                    others.append(choice)
            others.sort(key=fitted.square_of)
            return [best, *others], fitted
    return [], start


def _refined(problem: _Problem, fitted: _Linearised, chosen: tuple[int, ...]) -> FloatArray:
    """Estimate the chosen numbers by Gauss-Newton; the others stay as they are described."""
    places = list(chosen)
    changes = np.zeros(len(problem.parameters))
    changes[places] = fitted.solution(chosen)
    for _ in range(ITERATIONS):
        misfit, jacobian = problem.linearised(changes, chosen)
        white = np.column_stack((jacobian, misfit))
        if fitted.noise is not None:
            white = fitted.noise.white(white)
        columns = white[:, :-1]
        white_misfit = white[:, -1]
        step = -np.linalg.lstsq(columns, white_misfit, rcond=None)[0]
        changes[places] += step
        if float(np.max(np.abs(step))) < SETTLED:
            break
    return changes


def _estimates(
    fitted: _Linearised, chosen: tuple[int, ...]
) -> tuple[tuple[GeometryEstimate, ...], FloatArray]:
    """Changes of the chosen numbers with σ, and their covariance [rad or m]."""
    if not chosen:
        return (), np.zeros((0, 0))
    unit = fitted.problem.unit[list(chosen)]
    covariance = fitted.covariance(chosen) * np.outer(unit, unit)
    values = fitted.solution(chosen) * unit
    stds = np.sqrt(np.diag(covariance))
    estimates: list[GeometryEstimate] = []
    for index, value, std in zip(chosen, values, stds, strict=True):
        parameter = fitted.problem.parameters[index]
        estimates.append(GeometryEstimate(parameter, float(value), float(std)))
    return tuple(estimates), covariance
