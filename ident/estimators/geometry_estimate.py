"""Zeros and lengths of a robot with more encoders than degrees of freedom, from its recorded positions alone.

The pose that fits the m encoders best leaves a misfit e(θ) of m − d numbers a sample. Where the description is right,
it is the encoders' noise. θ are the changes of the described zeros and lengths (`ident.model.geometry`). The whole of
them is estimated by Gauss-Newton; linearised around that estimate, e ≈ J θ − y, the misfit of every choice of few
numbers is a small linear problem. The choice with the fewest numbers that leaves no more than the whole one does, by an
F test, is the explanation: one zero or one length before two, two before three. Numbers that are not in it stay as they
are described. Positions are used as they were recorded: a low-pass bends a closed loop, and the encoders' noise is that
of their counts.

Correlated misfits, as of arms that bend, are no noise of counts: σ² is multiplied by how much more the sums over
stretches of two seconds scatter than those of independent samples do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # loads its modules when they are first used

from ident.arrays import FloatArray, IntArray
from ident.data.dataset import LONGEST_MOVE_S
from ident.data.run import Run
from ident.model.closed_chain import positions, reach_near
from ident.model.closures import loops
from ident.model.geometry import (
    GeometryChange,
    GeometryKind,
    GeometryParameter,
    geometry_parameters,
    with_geometry,
)
from ident.model.geometry_derivatives import unit_of
from ident.model.model import Model
from ident.model.robot import JointKind, Robot

SPACING_S = 0.02  #: Least time between two positions that are used
MOST_POSITIONS = 600  #: Of all runs together; σ of a zero is then some 10⁻⁶ rad
LEAST_POSITIONS = 50  #: Fewer positions judge no geometry
MOST_CAUSES = 3  #: Numbers of the description that are looked for one by one; then all together
STEP = 1e-4  #: Change of a length from which the derivative of the closures is taken [of the robot's size]
ITERATIONS = 8
SETTLED = 1e-10  #: Change at which the iteration ends [rad, or of the robot's size]
SMALLEST_SINGULAR = 1e-9  #: Relative to the largest: rounding
LARGEST_STD = 1e-2
"""Direction with a larger σ [rad, or of the robot's size], half a degree: it counts as one that cannot be seen."""
PROBABILITY = 1e-4  #: That the true explanation is refused, and that noise alone is taken for a wrong description
SMALLEST_MISFIT = 2e-5
"""Misfit [rad, or of the robot's size] below which nothing is said: one twenty times larger moves a gain by 7 to 9 of
its σ, so this one by less than half of one."""


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Some recorded positions of one run."""

    run: str  #: its name
    position_rad: FloatArray  #: of the axes, as recorded, shape (k, m)
    stretch: IntArray  #: number of the stretch of LONGEST_MOVE_S that each belongs to, shape (k,)


@dataclass(frozen=True, slots=True)
class GeometryEstimate:
    """A number of the description that is wrong."""

    parameter: GeometryParameter
    change: float  #: what has to be added to it [rad or m]
    std: float  #: σ of the change


@dataclass(frozen=True, slots=True, eq=False)
class GeometryFinding:
    """What the encoders say of the geometry."""

    #: Root mean square of what is left of the encoders' positions beside the pose that fits them best, a direction
    #: [rad, or of the robot's size], with the described geometry.
    misfit: float
    misfit_left: float  #: the same with the corrections; where there are none, with all numbers estimated
    is_significant: bool  #: the description leaves more misfit than noise does
    corrections: tuple[GeometryEstimate, ...]  #: the explanation with the fewest numbers; empty without one
    covariance: FloatArray  #: of their changes, shape (p, p)
    #: Other explanations with as many numbers that these positions cannot distinguish from it.
    alternatives: tuple[tuple[GeometryEstimate, ...], ...]
    every: tuple[GeometryEstimate, ...]  #: all numbers, estimated together; σ is infinite where it cannot be seen
    unobservable: tuple[str, ...]  #: directions that no position shows, in words

    @property
    def changes(self) -> tuple[GeometryChange, ...]:
        """What has to be added to the description; empty without an explanation."""
        return tuple(GeometryChange(one.parameter, one.change) for one in self.corrections)


def thinned(run: Run) -> Positions:
    """Choose positions of a run that are SPACING_S apart and valid on every axis."""
    every = max(1, round(SPACING_S * run.rate_hz))
    chosen = np.arange(0, len(run.time_s), every)
    if run.valid is not None:
        chosen = chosen[np.asarray(run.valid)[chosen].all(axis=1)]
    elapsed_s = np.asarray(run.time_s)[chosen] - run.time_s[0]
    stretch = np.floor(elapsed_s / LONGEST_MOVE_S).astype(np.int64)
    return Positions(run.name, np.asarray(run.position_rad, dtype=np.float64)[chosen], stretch)


def estimate_geometry(model: Model, runs: Sequence[Positions]) -> GeometryFinding | None:
    """Compare the description with the encoders, and look for the fewest numbers of it that are wrong.

    Args:
        model: of the description.
        runs: recorded positions.

    Returns:
        None for a robot without redundant encoders, and where there are too few positions.

    Raises:
        ModelError: the loops cannot be closed, or the encoders contradict each other so much that no pose fits them.
    """
    if not model.is_redundant:
        return None
    axes_rad, stretch = _pooled(runs)
    if len(axes_rad) < LEAST_POSITIONS or len(np.unique(stretch)) < 2:
        return None
    problem = _Problem.of(model, axes_rad, stretch)
    start = _whole(problem)
    described = problem.misfit(np.zeros(len(problem.parameters)))
    misfit = float(np.sqrt(np.mean(described**2) / problem.share))
    chosen, fitted = _explained(problem, start)
    found = chosen[0] if chosen else ()
    corrections, covariance = _estimates(fitted, found)
    left = float(np.sqrt(fitted.square_of(found or fitted.all_numbers) / problem.directions))
    systematic = np.sqrt(max(fitted.square_of(()) - fitted.whole_square, 0.0) / problem.directions)
    is_significant = bool(not fitted.passes(()) and systematic > SMALLEST_MISFIT)
    if not is_significant:
        corrections, covariance, chosen = (), np.zeros((0, 0)), []
    return GeometryFinding(
        misfit=misfit,
        misfit_left=left if is_significant else misfit,
        is_significant=is_significant,
        corrections=corrections,
        covariance=covariance,
        alternatives=tuple(_estimates(fitted, other)[0] for other in chosen[1:]),
        every=fitted.every(),
        unobservable=fitted.unobservable(),
    )


def _pooled(runs: Sequence[Positions]) -> tuple[FloatArray, IntArray]:
    """Positions of all runs, at most MOST_POSITIONS, shape (k, m), and the stretch of each."""
    stretches: list[IntArray] = []
    last = 0
    for one in runs:
        stretches.append(one.stretch + last)
        last += int(one.stretch.max(initial=-1)) + 1
    axes_rad = np.concatenate([one.position_rad for one in runs])
    every = -(-len(axes_rad) // MOST_POSITIONS)
    return axes_rad[::every], np.concatenate(stretches)[::every]


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Recorded positions, and the poses with the described geometry from which others are near."""

    model: Model
    parameters: tuple[GeometryParameter, ...]
    unit: FloatArray  #: of each parameter: a radian, or the robot's size [m], shape (p,)
    axes_rad: FloatArray  #: recorded, shape (k, m)
    axis_unit: FloatArray  #: the same of each axis, shape (m,)
    near_rad: FloatArray  #: of all joints, shape (k, n)
    stretch: IntArray  #: of each sample, shape (k,)

    @classmethod
    def of(cls, model: Model, axes_rad: FloatArray, stretch: IntArray) -> _Problem:
        parameters = geometry_parameters(model.robot)
        size_m = model.assembly.size_m
        kinds = [joint.kind for joint in model.robot.axes]
        return cls(
            model=model,
            parameters=parameters,
            unit=np.array([unit_of(model, one) for one in parameters]),
            axes_rad=axes_rad,
            axis_unit=np.array([1.0 if kind is JointKind.REVOLUTE else size_m for kind in kinds]),
            near_rad=positions(model.robot, model.assembly, axes_rad),
            stretch=stretch,
        )

    @property
    def share(self) -> float:
        """Share of the m numbers of a sample in which a misfit can be, (m − d)/m."""
        motors = self.model.robot.axis_count
        return (motors - self.model.assembly.mobility) / motors

    @property
    def directions(self) -> int:
        """Independent numbers in all misfits, k (m − d)."""
        return round(self.share * self.axes_rad.size)

    def misfit(self, changes: FloatArray) -> FloatArray:
        """e with changes of all parameters in their units, shape (k m,)."""
        return self._apart(self._closed(self._changed(changes)))

    def _changed(self, changes: FloatArray) -> Robot:
        """Robot with changes of all parameters in their units."""
        numbers = zip(self.parameters, changes * self.unit, strict=True)
        return with_geometry(
            self.model.robot, [GeometryChange(parameter, float(change)) for parameter, change in numbers]
        )

    def _closed(self, robot: Robot) -> FloatArray:
        """Poses of another geometry that fit the encoders best, shape (k, n)."""
        return reach_near(robot, self.model.assembly, self.near_rad, self.axes_rad).position_rad

    def _apart(self, position_rad: FloatArray) -> FloatArray:
        """e of poses, shape (k m,)."""
        apart = self.axes_rad - position_rad[:, list(self.model.robot.axis_joints)]
        return np.asarray((apart / self.axis_unit).ravel())

    def linearised(self, changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """e and its derivatives to all parameters, in their units, shapes (k m,) and (k m, p).

        With P = I − A (AᵀA)⁻¹ Aᵀ, a zero moves e by P e_j, and a length by −P times what the motors' joints move where
        x stays: J_d dq_d = −∂φ/∂θ. φ is linear in lengths, so that a difference of it is exact.
        """
        robot = self._changed(changes)
        assembly = self.model.assembly
        motors = list(robot.axis_joints)
        x = list(assembly.independent)
        rest = list(assembly.dependent)
        position_rad = self._closed(robot)
        closing = loops(robot, position_rad, assembly.size_m)
        q, r = np.linalg.qr(closing.jacobian[:, :, rest])
        samples, _, joints = closing.jacobian.shape
        to_joints = np.zeros((samples, joints, len(x)))
        to_joints[:, x] = np.eye(len(x))
        to_joints[:, rest] = -np.linalg.solve(r, np.swapaxes(q, 1, 2) @ closing.jacobian[:, :, x])
        onto = np.linalg.qr(to_joints[:, motors]).Q
        hidden = np.eye(len(motors)) - onto @ np.swapaxes(onto, 1, 2)
        columns: list[FloatArray] = []
        for parameter, unit in zip(self.parameters, self.unit, strict=True):
            if parameter.kind is GeometryKind.ZERO:
                axis = [joint.name for joint in robot.axes].index(parameter.joint)
                column = hidden[:, :, axis]
            else:
                longer = with_geometry(robot, (GeometryChange(parameter, STEP * unit),))
                gap = loops(longer, position_rad, assembly.size_m).residual - closing.residual
                moved = np.zeros((samples, joints))
                moved[:, rest] = -np.linalg.solve(r, np.einsum("kcr,kc->kr", q, gap)[..., None])[..., 0] / (STEP * unit)
                column = -np.einsum("kij,kj->ki", hidden, moved[:, motors])
            columns.append((unit * column / self.axis_unit).ravel())
        return self._apart(position_rad), np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """e ≈ J θ − y around an estimate, reduced to a triangle, and the noise of all numbers together."""

    problem: _Problem
    triangle: FloatArray  #: R of [J | y], shape (p + 1, p + 1)
    singular: FloatArray  #: singular values of J, shape (p,)
    ways: FloatArray  #: right singular vectors, a row each, shape (p, p)
    seen: int  #: how many of them these positions show
    variance: FloatArray  #: σ² of a misfit, correlation included, shape ()
    whole_square: float  #: Σe² with all that is seen estimated

    @classmethod
    def at(cls, problem: _Problem, changes: FloatArray) -> _Linearised:
        misfit, jacobian = problem.linearised(changes)
        right = jacobian @ changes - misfit
        left, singular, ways = np.linalg.svd(jacobian, full_matrices=False)
        seen = int(np.sum(singular > SMALLEST_SINGULAR * singular[0]))
        while True:
            onto = left[:, :seen]
            residual = right - onto @ (onto.T @ right)
            square = float(residual @ residual)
            variance = square / max(problem.directions - seen, 1)
            variance *= _correlation(problem, onto, residual, variance)
            visible = int(np.sum(np.sqrt(variance) < LARGEST_STD * singular[:seen]))
            if visible == seen:
                break
            seen = visible
        triangle = np.asarray(np.linalg.qr(np.column_stack((jacobian, right)), mode="r"))
        return cls(problem, triangle, singular, ways, seen, np.asarray(variance), square)

    @property
    def all_numbers(self) -> tuple[int, ...]:
        """Indices of all parameters."""
        return tuple(range(len(self.problem.parameters)))

    def solution(self, chosen: Sequence[int]) -> FloatArray:
        """The chosen changes that leave the least misfit, in their units."""
        return np.asarray(np.linalg.lstsq(self.triangle[:, list(chosen)], self.triangle[:, -1], rcond=None)[0])

    def square_of(self, chosen: Sequence[int]) -> float:
        """Σe² that is left when only these numbers change."""
        if len(chosen) == len(self.problem.parameters):
            return self.whole_square
        left = self.triangle[:, -1]
        if chosen:
            left = left - self.triangle[:, list(chosen)] @ self.solution(chosen)
        return float(left @ left)

    def passes(self, chosen: Sequence[int]) -> bool:
        """Whether these numbers alone explain the misfit as well as all that can be seen."""
        others = self.seen - len(chosen)
        if others <= 0:
            return True
        excess = (self.square_of(chosen) - self.whole_square) / others
        stretches = len(np.unique(self.problem.stretch))
        limit = float(scipy.stats.f.isf(PROBABILITY, others, stretches - 1))
        return bool(excess <= limit * self.variance)

    def covariance(self, chosen: Sequence[int]) -> FloatArray:
        """Covariance of the chosen changes, in their units."""
        upper = np.linalg.qr(self.triangle[:, list(chosen)], mode="r")
        inverse = np.linalg.inv(upper)
        return np.asarray(self.variance * (inverse @ inverse.T))

    def every(self) -> tuple[GeometryEstimate, ...]:
        """All numbers estimated together, as far as they are seen."""
        ways = self.ways[: self.seen].T
        scaled = np.linalg.lstsq(self.triangle[:, :-1] @ ways, self.triangle[:, -1], rcond=None)[0]
        values = ways @ scaled
        variance = self.variance * np.sum((ways / self.singular[: self.seen]) ** 2, axis=1)
        hidden = np.sum(self.ways[self.seen :] ** 2, axis=0) > SMALLEST_SINGULAR
        std = np.where(hidden, np.inf, np.sqrt(variance))
        unit = self.problem.unit
        numbers = zip(self.problem.parameters, values * unit, std * unit, strict=True)
        return tuple(GeometryEstimate(parameter, float(value), float(one)) for parameter, value, one in numbers)

    def unobservable(self) -> tuple[str, ...]:
        """Directions that the positions do not show, by the numbers that have the largest part in them."""
        return tuple(self._direction(way) for way in self.ways[self.seen :])

    def _direction(self, way: FloatArray) -> str:
        largest = np.abs(way).max()
        parts = [
            f"{share:+.2f} {parameter.name}"
            for share, parameter in zip(way, self.problem.parameters, strict=True)
            if abs(share) > 0.1 * largest
        ]
        return ", ".join(parts)


def _correlation(problem: _Problem, onto: FloatArray, residual: FloatArray, variance: float) -> float:
    """How much more the sums over stretches scatter than those of independent samples, at least 1.

    Args:
        problem: with the stretches.
        onto: orthonormal basis of the columns, shape (k m, r): the sums are those that an estimate is made of.
        residual: e of the estimate, shape (k m,).
        variance: σ² of independent misfits.
    """
    if variance == 0.0:
        return 1.0
    stretch = np.repeat(problem.stretch, problem.model.robot.axis_count)
    _, index = np.unique(stretch, return_inverse=True)
    count = int(index.max()) + 1
    sums = np.zeros((count, onto.shape[1]))
    np.add.at(sums, index, onto * residual[:, None])
    scatter = np.sum(sums**2, axis=0) * count / (count - 1)
    return float(max(1.0, np.mean(scatter) / variance))


def _whole(problem: _Problem) -> _Linearised:
    """Linearise around the estimate of all numbers; directions that are not seen stay as they are described."""
    changes = np.zeros(len(problem.parameters))
    fitted = _Linearised.at(problem, changes)
    for _ in range(ITERATIONS):
        ways = fitted.ways[: fitted.seen].T
        seen_part = np.linalg.lstsq(fitted.triangle[:, :-1] @ ways, fitted.triangle[:, -1], rcond=None)[0]
        new = ways @ seen_part
        step = float(np.max(np.abs(new - changes)))
        changes = new
        fitted = _Linearised.at(problem, changes)
        if step < SETTLED + 1e-3 * np.sqrt(float(fitted.variance)):
            break
    return fitted


def _explained(problem: _Problem, start: _Linearised) -> tuple[list[tuple[int, ...]], _Linearised]:
    """Choices of the fewest numbers that explain the misfit, the best first, linearised around the best of them."""
    fitted = start
    chosen: list[tuple[int, ...]] = []
    if start.passes(()):
        return chosen, fitted
    for _ in range(MOST_CAUSES):
        before = chosen[:1]
        chosen = [*_fewest(fitted)]
        if not chosen or chosen[:1] == before:
            break
        fitted = _Linearised.at(problem, _refined(problem, fitted, chosen[0]))
    return chosen, fitted


def _fewest(fitted: _Linearised) -> Iterator[tuple[int, ...]]:
    """Yield the smallest choices that pass, the best first; none where only all numbers together would."""
    for size in range(1, MOST_CAUSES + 1):
        passed = [one for one in combinations(fitted.all_numbers, size) if fitted.passes(one)]
        if passed:
            yield from sorted(passed, key=fitted.square_of)
            return
    if fitted.seen == len(fitted.all_numbers):
        yield fitted.all_numbers


def _refined(problem: _Problem, fitted: _Linearised, chosen: tuple[int, ...]) -> FloatArray:
    """Estimate the chosen numbers by Gauss-Newton; the others stay as they are described."""
    changes = np.zeros(len(problem.parameters))
    changes[list(chosen)] = fitted.solution(chosen)
    for _ in range(ITERATIONS):
        misfit, jacobian = problem.linearised(changes)
        step = -np.linalg.lstsq(jacobian[:, list(chosen)], misfit, rcond=None)[0]
        changes[list(chosen)] += step
        if float(np.max(np.abs(step))) < SETTLED:
            break
    return changes


def _estimates(fitted: _Linearised, chosen: tuple[int, ...]) -> tuple[tuple[GeometryEstimate, ...], FloatArray]:
    """Changes of the chosen numbers with σ, and their covariance [rad or m]."""
    if not chosen:
        return (), np.zeros((0, 0))
    unit = fitted.problem.unit[list(chosen)]
    covariance = fitted.covariance(chosen) * np.outer(unit, unit)
    values = fitted.solution(chosen) * unit
    std = np.sqrt(np.diag(covariance))
    numbers = zip(chosen, values, std, strict=True)
    found = tuple(
        GeometryEstimate(fitted.problem.parameters[index], float(value), float(one)) for index, value, one in numbers
    )
    return found, covariance
