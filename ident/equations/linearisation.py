"""The problem around an estimate as a linear one, and everything that leaves moves out of it.

The residual of motor i is e_i = (v_i − γ_i (T τ)_i)/σ_i with the unknowns (g_1 … g_m, χ, χ_uL); see
estimators/maximum_likelihood.py. Its derivative to a gain is built from the *predicted* torque, not
from the measured current, so that the noise does not enter it. `motor_jacobian` is that derivative.
Error bars leave out one move at a time (`left_out_shifts`); the search for effects leaves out folds
of moves (`cut_into_folds`).

With f unknowns, J is the Jacobian −∂e/∂(unknowns) of all rows, JᵀJ the Hessian of ‖e‖²/2, and Jᵀe
the score. Where motors work against each other (a redundant drive), whitening also projects the
internal preload N out of the rows: T_D = P D⁻¹ with P = 1 − D⁻¹N(NᵀD⁻²N)⁻¹NᵀD⁻¹ and D = diag(g_i
σ_i) takes the place of D⁻¹ (`ident.equations.currents.whitening_transform`). Rows that share errors
within a run are multiplied by V^(−1/2) (`ident.equations.run_scatter`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray, IntArray
from ident.equations.currents import PreloadedCurrents, whitening_transform
from ident.equations.observation import Observation
from ident.equations.run_scatter import RunScatter
from ident.equations.system import System
from ident.errors import TooFewMoves

#: The lower Cholesky factor, with the flag that `scipy.linalg.cho_solve` asks for
CholeskyFactor = tuple[FloatArray, bool]

#: Fields of a linearisation with one entry a row
LINEARISATION_ROWS = ("residual", "current", "motor", "cluster", "source")
MIN_MOVES_TO_LEAVE_OUT = 8  #: With fewer, leaving one out shows little of the scatter
FOLDS = MIN_MOVES_TO_LEAVE_OUT  #: Of moves; each holds one at least
#: Columns of a candidate up to which the products of single rows are summed; see `MotorRows.grams`
MOST_SUMMED = 2
RIDGE = 1e-10  #: Share of the diagonal of JᵀJ added to it: two effects may be nearly equal
#: Standard errors of the correlation of neighbouring clusters, above which they are joined
CORRELATED = 2.0


@dataclass(frozen=True, slots=True)
class Jacobian:
    """Jacobian stored motor by motor, without the unknowns that a motor does not have.

    The equation of a motor near the flange has few of them: less than half of the numbers of the
    matrix are stored.
    """

    parts: tuple[FloatArray, ...]  #: of each motor's rows, columns first, shapes (s_i, rows_i)
    seen: tuple[IntArray, ...]  #: unknowns in each motor's equation, shapes (s_i,)
    width: int  #: number of unknowns, f

    def __matmul__(self, step: FloatArray) -> FloatArray:
        """J x, shape (rows,), from x, shape (f,)."""
        by_motor: list[FloatArray] = []
        for part, seen in zip(self.parts, self.seen, strict=True):
            by_motor.append(step[seen] @ part)
        return np.concatenate(by_motor)

    def columns(self, chosen: IntArray) -> FloatArray:
        """Some of its columns, shape (rows, k)."""
        own = self.only(chosen)
        parts: list[FloatArray] = []
        for part, seen in zip(own.parts, own.seen, strict=True):
            rows = part.shape[1]
            of_motor = np.zeros((rows, own.width))
            of_motor[:, seen] = part.T
            parts.append(of_motor)
        return np.concatenate(parts)

    def only(self, chosen: IntArray) -> Jacobian:
        """A copy with some of its columns."""
        parts: list[FloatArray] = []
        numbers: list[IntArray] = []
        for part, seen in zip(self.parts, self.seen, strict=True):
            is_chosen = np.isin(seen, chosen)
            parts.append(part[is_chosen])
            numbers.append(np.searchsorted(chosen, seen[is_chosen]))
        return Jacobian(tuple(parts), tuple(numbers), len(chosen))

    def on_columns(self, columns: FloatArray) -> FloatArray:
        """JᵀΦ, shape (f, …), from columns on all rows, shape (rows, …)."""
        out = np.zeros((self.width, *columns.shape[1:]))
        ends = np.cumsum([part.shape[1] for part in self.parts])
        by_motor = np.split(columns, ends[:-1])
        for part, seen, own in zip(self.parts, self.seen, by_motor, strict=True):
            out[seen] += part @ own
        return out


def sum_of_squares(jacobian: Jacobian) -> FloatArray:
    """JᵀJ, shape (f, f)."""
    hessian = np.zeros((jacobian.width, jacobian.width))
    for part, seen in zip(jacobian.parts, jacobian.seen, strict=True):
        hessian[np.ix_(seen, seen)] += part @ part.T
    return hessian


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Rows of all motors below each other, motor 1 first."""

    #: ∂(γ (T τ)/σ)/∂x, whitened, to the free unknowns in units of ``scale``
    jacobian: Jacobian
    residual: FloatArray  #: whitened, shape (rows,)
    current: FloatArray  #: measured, whitened: what the residual is relative to, shape (rows,)
    motor: IntArray  #: of each row, shape (rows,)
    cluster: IntArray  #: number of each row's cluster, 0 … without gaps, shape (rows,)
    source: IntArray  #: index of each row among the observation's decimated rows, shape (rows,)
    gamma: FloatArray  #: 1/g, shape (m,)
    noise: FloatArray  #: σ_i [A], shape (m,)
    free: IntArray  #: which of (gains, parameters) are free, shape (f,)
    #: Unit of each free unknown: a step of one in the scaled unknown is this much of the real one,
    #: shape (f,).
    scale: FloatArray
    #: T_D of each of the observation's rows for a redundantly driven robot, shape (r, m, m); None
    #: where the whitening is D⁻¹, one number a motor.
    transform: FloatArray | None = None
    #: V, the covariance of errors that the rows of a run share; jacobian and residual have been
    #: multiplied by V^(−1/2). None where rows share no errors.
    scatter: RunScatter | None = None

    @property
    def cluster_count(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

    def of_clusters(self, per_row: IntArray) -> IntArray:
        """Number of each cluster, (clusters,), from one of each of the observation's rows, (r,).

        Such a number, of a run or a move, is the same in all rows of a cluster.
        """
        _, first_rows = np.unique(self.cluster, return_index=True)
        return per_row[self.source[first_rows]]

    def rows_of(self, motor: int) -> slice:
        """Rows of one motor."""
        first, end = np.searchsorted(self.motor, (motor, motor + 1))
        return slice(int(first), int(end))

    def effective_rows(self, motor: int) -> float:
        """Number of a motor's rows, less those whose noise the projection of preload takes out.

        It is Σ P_ii of the motor i over its rows, the expectation of ‖e‖² of noise alone.
        """
        rows = self.rows_of(motor)
        if self.transform is None:
            return float(rows.stop - rows.start)
        diagonal = self.transform[self.source[rows], motor, motor]  # of T_D = P D⁻¹
        noise = self.noise[motor]
        gamma = self.gamma[motor]
        return float(diagonal.sum() * noise / gamma)

    def columns_by_motor(
        self, torque_nm: FloatArray, to_motor: FloatArray
    ) -> dict[int, FloatArray]:
        """Further columns of the Jacobian from joint torque, by motor: whitened, decorrelated.

        Only motors that must supply some of the torque have an entry, of shape (extra, rows).

        Args:
            torque_nm: per unit of each column, shape (m, extra, r).
            to_motor: T (DriveTrain.to_motor).
        """
        whitened = self.whitened_by_motor(torque_nm, to_motor)
        (decorrelated,) = self.decorrelated_by_motor([whitened])
        return decorrelated

    def whitened_by_motor(
        self, torque_nm: FloatArray, to_motor: FloatArray
    ) -> dict[int, FloatArray]:
        """The same, whitened only: `decorrelated_by_motor` is still to be done."""
        by_motor: dict[int, FloatArray] = {}
        if self.transform is not None:
            for motor in range(len(self.gamma)):
                source = self.source[self.rows_of(motor)]
                torque = torque_nm.take(source, axis=2)
                # Σ_j (T_D)_rij τ_jer of motor i, column e and row r
                by_motor[motor] = np.einsum("rj,jer->er", self.transform[source, motor], torque)
            return by_motor
        for joint in np.flatnonzero(torque_nm.any(axis=(1, 2))):
            for motor in np.flatnonzero(to_motor[:, joint]).tolist():
                source = self.source[self.rows_of(motor)]
                # γ_i T_ij/σ_i τ_j; several joints may load one motor.
                scale = to_motor[motor, joint] * self.gamma[motor] / self.noise[motor]
                of_joint = torque_nm[joint].take(source, axis=1)
                of_joint *= scale
                if motor in by_motor:
                    by_motor[motor] = by_motor[motor] + of_joint
                else:
                    by_motor[motor] = of_joint
        return by_motor

    def decorrelated_by_motor(
        self, each: Sequence[dict[int, FloatArray]]
    ) -> list[dict[int, FloatArray]]:
        """Multiply whitened columns of several candidates by V^(−1/2); together, which is faster.

        Args:
            each: of each candidate, the columns by motor, shapes (extra, rows).
        """
        if self.scatter is None:
            return list(each)
        decorrelated: list[dict[int, FloatArray]] = [{} for _ in each]
        for motor in range(len(self.gamma)):
            candidates = [number for number, by_motor in enumerate(each) if motor in by_motor]
            if not candidates:
                continue
            columns = [each[number][motor] for number in candidates]
            ends = np.cumsum([len(own) for own in columns])
            stacked = self.scatter.decorrelate(motor, np.concatenate(columns))
            parts = np.split(stacked, ends[:-1])
            for number, part in zip(candidates, parts, strict=True):
                decorrelated[number][motor] = part
        return decorrelated

    def decorrelated_from_runs(
        self, torque_nm: FloatArray, to_motor: FloatArray, run: IntArray
    ) -> Linearisation:
        """The same problem with rows multiplied by V^(−1/2); the unknowns stay the same.

        Args:
            torque_nm: of one standard deviation of each error, shape (m, k, r).
            to_motor: T (DriveTrain.to_motor).
            run: of each of the observation's rows, shape (r,).
        """
        whitened = self.whitened(torque_nm, to_motor).T
        rows = [self.rows_of(motor) for motor in range(len(self.gamma))]
        columns = [whitened[:, own] for own in rows]
        runs = [run[self.source[own]] for own in rows]
        scatter = RunScatter.of(columns, runs)
        parts: list[FloatArray] = []
        for motor, part in enumerate(self.jacobian.parts):
            parts.append(scatter.decorrelate(motor, part))
        jacobian = replace(self.jacobian, parts=tuple(parts))
        residual = self._by_motor(scatter.decorrelate, self.residual)
        return replace(self, jacobian=jacobian, residual=residual, scatter=scatter)

    def fitted(self) -> tuple[Linearisation, FloatArray]:
        """The same around the best fit of its rows, and the scaled step to it, shape (f,)."""
        hessian = sum_of_squares(self.jacobian)
        hessian[np.diag_indices_from(hessian)] *= 1.0 + RIDGE
        factor = lower_factor(hessian)
        score = self.jacobian.on_columns(self.residual)
        step = linalg.cho_solve(factor, score)
        residual = self.residual - self.jacobian @ step
        return replace(self, residual=residual), step

    def decorrelated(self, columns: FloatArray) -> FloatArray:
        """V^(−1/2) times one number a row, shape (rows,); V is 1 where runs share no errors."""
        if self.scatter is None:
            return columns
        return self._by_motor(self.scatter.decorrelate, columns)

    def correlated(self, columns: FloatArray) -> FloatArray:
        """V times one number a row, shape (rows,); V is 1 where runs share no errors."""
        if self.scatter is None:
            return columns
        return self._by_motor(self.scatter.correlate, columns)

    def _by_motor(
        self, product: Callable[[int, FloatArray], FloatArray], columns: FloatArray
    ) -> FloatArray:
        """A product of `RunScatter` with one number a row, shape (rows,)."""
        parts: list[FloatArray] = []
        for motor in range(len(self.gamma)):
            own = columns[None, self.rows_of(motor)]
            (part,) = product(motor, own)
            parts.append(part)
        return np.concatenate(parts)

    def whitened(self, torque_nm: FloatArray, to_motor: FloatArray) -> FloatArray:
        """The columns of `columns_by_motor` as one matrix with zeros, shape (rows, extra)."""
        by_motor = self.columns_by_motor(torque_nm, to_motor)
        columns = np.zeros((torque_nm.shape[1], len(self.motor)))
        for motor, own in by_motor.items():
            columns[:, self.rows_of(motor)] = own
        return columns.T


def linearise(
    observation: Observation,
    gains: FloatArray,
    parameters: FloatArray,
    noise: FloatArray,
    *,
    gains_fixed: bool,
) -> Linearisation:
    """Linearise around given gains [Nm/A], (m,), parameters, (p,), and current noise [A] of each
    motor, (m,).
    """
    count = len(gains)
    width = count + len(parameters)
    first_free = 0
    if gains_fixed:
        first_free = count
    used = [np.flatnonzero(use) for use in observation.motor_use]
    columns_and_rows = zip(observation.motor_columns(), used, strict=True)
    rows_of_motors = (columns[:, rows].T for columns, rows in columns_and_rows)
    used_preload = observation.preload[:, :, used[0]]
    preload = used_preload.transpose(2, 0, 1)
    parts: list[FloatArray] = []
    seen: list[IntArray] = []
    residuals: list[FloatArray] = []
    currents: list[FloatArray] = []
    squares = np.zeros(width)
    for jacobian, residual, current in motor_jacobians(
        rows_of_motors, preload, gains, parameters, noise
    ):
        squares += np.einsum("rf,rf->f", jacobian, jacobian)  # Σ_r J_rf²
        own = np.flatnonzero(jacobian[:, first_free:].any(axis=0))  # numbered among the free
        seen.append(own)
        own_jacobian = jacobian[:, first_free + own]
        parts.append(np.ascontiguousarray(own_jacobian.T))
        residuals.append(residual)
        currents.append(current)
    # A gain is in units of itself, a parameter in that in which its column has the norm one.
    parameter_unit = _inverse_norms(squares[count:])
    unit = np.concatenate((gains, parameter_unit))[first_free:]
    for part, own in zip(parts, seen, strict=True):
        np.multiply(part, unit[own, None], out=part)  # in place: the parts are large
    source = np.concatenate(used)
    row_counts = [len(rows) for rows in used]
    _, cluster = np.unique(observation.move[source], return_inverse=True)
    transform = None
    if preload.size:
        every_preload = observation.preload.transpose(2, 0, 1)
        transform = whitening_transform(every_preload, gains, noise)
    jacobian_of_all = Jacobian(tuple(parts), tuple(seen), width - first_free)
    motor = np.repeat(np.arange(count), row_counts)
    return Linearisation(
        jacobian=jacobian_of_all,
        residual=np.concatenate(residuals),
        current=np.concatenate(currents),
        motor=motor,
        cluster=cluster.astype(np.int64),
        source=source,
        gamma=1.0 / gains,
        noise=noise,
        free=np.arange(first_free, width),
        scale=unit,
        transform=transform,
    )


def _inverse_norms(squares: FloatArray) -> FloatArray:
    """1/‖column‖ from ‖column‖²; one for a column that is zero."""
    norms = np.sqrt(squares)
    ones = np.ones(len(norms))
    return np.divide(1.0, norms, where=norms > 0, out=ones)


def motor_jacobians(
    rows: Iterable[FloatArray],
    preload: FloatArray,
    gains: FloatArray,
    parameters: FloatArray,
    noise: FloatArray,
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """J, e and the measured current in units of its noise, of each motor's equations in turn.

    Args:
        rows: of each motor, see `motor_jacobian`. With preload, all motors have rows of the same
            samples, and m columns V_i of currents in the place of v_i.
        preload: N of the rows, shape (r, m, m − d).
        gains, parameters, noise: see `motor_jacobian`.
    """
    if not preload.size:
        for motor, own in enumerate(rows):
            jacobian, residual = motor_jacobian(own, motor, gains, parameters, noise)
            current = own[:, 0] / noise[motor]
            yield jacobian, residual, current
        return
    currents = PreloadedCurrents.of_rows(list(rows), preload)
    whitened = currents.whitened(gains, noise)
    residual = whitened.residual(gains, parameters)
    corrected = currents.corrected(gains, noise, whitened, residual)
    jacobian = np.concatenate((-corrected, whitened.linear), axis=1)
    current = whitened.drive @ gains
    count = len(gains)
    jacobians = np.split(jacobian, count)
    residuals = np.split(residual, count)
    currents_of_motors = np.split(current, count)
    yield from zip(jacobians, residuals, currents_of_motors, strict=True)


def motor_jacobian(
    rows: FloatArray, motor: int, gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """J = ∂(γ_i (T τ)_i/σ_i)/∂(g, χ, χ_uL) and e of one motor, shapes (r, m + p) and (r,).

    Args:
        rows: [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], or the triangle of these, which has the
            same JᵀJ and Jᵀe.
        motor: i.
        gains, parameters: where to linearise.
        noise: σ of each motor's current [A].
    """
    count = len(gains)
    gain = gains[motor]
    std_a = noise[motor]
    columns = rows[:, 1:-1]
    known = rows[:, -1]
    torque = columns @ parameters + known
    scale = 1.0 / (gain * std_a)
    jacobian = np.zeros((len(rows), count + len(parameters)))
    jacobian[:, motor] = -scale / gain * torque  # ∂(γ τ)/∂g = −γ² τ
    jacobian[:, count:] = scale * columns
    current = rows[:, 0] / std_a
    residual = current - scale * torque
    return jacobian, residual


def left_out_shifts(grams: FloatArray, scores: FloatArray) -> FloatArray:
    """Shift of the estimate when each cluster is left out, shape (C, f).

    It is d_c = −(H − G_c)⁻¹ s_c with H = Σ G_c, one step of Gauss-Newton.

    Args:
        grams: G_c = J_cᵀJ_c of each cluster, shape (C, f, f).
        scores: s_c = J_cᵀe_c around the estimate, where they sum to zero, shape (C, f).
    """
    hessian = grams.sum(axis=0)
    unit = even_unit(hessian)
    hessians_without = (hessian - grams) * np.outer(unit, unit)
    steps: list[FloatArray] = []
    for matrix, score in zip(hessians_without, scores, strict=True):
        step = _solved(matrix, score * unit)
        steps.append(step * unit)
    return -np.stack(steps)


def even_unit(hessian: FloatArray) -> FloatArray:
    """Return the units in which the diagonal of H is one, shape (f,).

    Some unknowns are in kg, some in kg m²: the factorisation then compares like with like.
    """
    diagonal = np.diag(hessian)
    squares = np.where(diagonal > 0.0, diagonal, 1.0)
    return 1.0 / np.sqrt(squares)


def lower_factor(matrix: FloatArray) -> CholeskyFactor:
    """Lower Cholesky factor L of a positive definite matrix A = L Lᵀ of shape (f, f).

    Raises:
        scipy.linalg.LinAlgError: A is not positive definite.
    """
    # From scipy 1.18 on its flag is an array, before it a bool.
    lower, _ = linalg.cho_factor(matrix, lower=True)
    return lower, True


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of A x = b by Cholesky's factorisation; by least squares where A is singular."""
    try:
        factor = lower_factor(matrix)
        return np.asarray(linalg.cho_solve(factor, right))
    except linalg.LinAlgError:  # a direction that only the cluster left out has seen
        solution, *_ = np.linalg.lstsq(matrix, right, rcond=None)
        return np.asarray(solution)


def scatter_of(shifts: FloatArray) -> FloatArray:
    """Jackknife covariance (C − 1)/C Σ (d_c − d̄)(d_c − d̄)ᵀ with the mean d̄, shape (f, f).

    Args:
        shifts: d_c of C clusters, shape (C, f).
    """
    count = len(shifts)
    centred = shifts - shifts.mean(axis=0)
    factor = (count - 1) / count
    return np.asarray(factor * (centred.T @ centred))


def independent_blocks(grams: FloatArray, scores: FloatArray, runs: IntArray) -> IntArray:
    """Join neighbouring clusters of a run in pairs until they are independent of each other.

    Clusters are moves, and pieces of 2 s of longer moves: long compared with the noise of drives,
    but not with every misfit of a model. The correlation of neighbours, in units in which all
    unknowns are known equally well, is

        r = Σ z_cᵀz_c₊₁ / Σ z_cᵀz_c,      z = L⁻¹ s,      L Lᵀ = H,

    and its standard error is √(Σ (z_cᵀz_c₊₁)²) / Σ z_cᵀz_c. The r of independent clusters is a
    little below zero, because all scores together are zero. Blocks become longer until r is at most
    CORRELATED standard errors (batch means: Fishman 1978).

    Args:
        grams: G_c of each cluster, shape (C, f, f), in the order of time.
        scores: s_c, shape (C, f).
        runs: run of each cluster, shape (C,).

    Returns:
        first cluster of each block, ascending; at least MIN_MOVES_TO_LEAVE_OUT where there are as
        many clusters.
    """
    starts = np.arange(len(grams))
    hessian = grams.sum(axis=0)
    unit = even_unit(hessian)
    scaled = hessian * np.outer(unit, unit)
    scaled[np.diag_indices_from(scaled)] += 1e-9  # a direction that no row shows
    lower = np.linalg.cholesky(scaled)
    while True:
        scaled_scores = scores * unit
        z = linalg.solve_triangular(lower, scaled_scores.T, lower=True).T
        products = np.sum(z[1:] * z[:-1], axis=1)
        is_same_run = runs[1:] == runs[:-1]
        products = products[is_same_run]
        # r and its standard error, both times Σ z_cᵀz_c.
        scaled_error = float(np.linalg.norm(products))
        if float(products.sum()) <= CORRELATED * scaled_error:
            return starts
        first = every_other_of_run(runs)
        if len(first) < MIN_MOVES_TO_LEAVE_OUT:
            return starts
        starts = starts[first]
        scores = np.add.reduceat(scores, first)
        runs = runs[first]


def every_other_of_run(runs: IntArray) -> IntArray:
    """Return the indices of the first, third, … entry of each run, ascending."""
    chosen: list[IntArray] = []
    for run in np.unique(runs):
        of_run = np.flatnonzero(runs == run)
        chosen.append(of_run[::2])
    return np.sort(np.concatenate(chosen))


def jackknife_covariance(
    system: System,
    gains: FloatArray,
    parameters: FloatArray,
    noise: FloatArray,
    *,
    gains_fixed: bool,
    recorded: System | None = None,
) -> FloatArray:
    """Covariance of (gains, parameters) from leaving out one move at a time, zero for fixed gains.

    The residual of a geared robot is correlated over a move (lag one about 0.67): rows are not
    independent, moves nearly are (MacKinnon & White 1985; for clusters Bell & McCaffrey 2002, CR3;
    docs/explanation/uncertainty.md). Where they are not, several are left out together
    (`independent_blocks`).

    Args:
        system: of the fit.
        gains, parameters: the estimate, gains in Nm/A, shapes (m,) and (p,).
        noise: σ_i of each motor's current [A], shape (m,).
        gains_fixed: the gains were given.
        recorded: equations whose residuals e are used, where J is of rows that are projected on
            instruments (``iv``); those of ``system`` when None.

    Returns:
        shape (m + p, m + p).

    Raises:
        TooFewMoves: fewer than MIN_MOVES_TO_LEAVE_OUT.
    """
    clusters = len(system.clusters)
    if clusters < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(clusters, MIN_MOVES_TO_LEAVE_OUT)
    size = len(gains) + len(parameters)
    first_free = 0
    if gains_fixed:
        first_free = len(gains)
    free = slice(first_free, size)
    if recorded is None:
        recorded = system
    if system.preload:
        grams, scores = _sums_with_preload(system, gains, parameters, noise)
    else:
        grams, scores, _ = sums_of_motors(system, recorded, gains, parameters, noise)
    runs = np.array([run for run, _ in system.cluster_runs])
    free_grams = grams[:, free, free]
    free_scores = scores[:, free]
    starts = independent_blocks(free_grams, free_scores, runs)
    block_grams = np.add.reduceat(free_grams, starts)
    block_scores = np.add.reduceat(free_scores, starts)
    shifts = left_out_shifts(block_grams, block_scores)
    covariance = np.zeros((size, size))
    covariance[free, free] = scatter_of(shifts)
    return covariance


def _sums_with_preload(
    system: System, gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """JᵀJ and Jᵀe of each cluster of a redundant drive, shapes (C, f, f) and (C, f)."""
    clusters = len(system.clusters)
    size = len(gains) + len(parameters)
    grams = np.zeros((clusters, size, size))
    scores = np.zeros((clusters, size))
    for index, cluster in enumerate(system.clusters):
        preload = system.preload_of(index)
        for jacobian, residual, _ in motor_jacobians(cluster, preload, gains, parameters, noise):
            grams[index] += jacobian.T @ jacobian
            scores[index] += jacobian.T @ residual
    return grams, scores


def sums_of_motors(
    system: System, recorded: System, gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """JᵀJ and Jᵀe of each cluster, shapes (C, f, f) and (C, f), and eᵀe of all.

    A motor is linearised on the rows of all clusters at once, and products are made of the unknowns
    that it has: near the flange these are less than half.

    Args:
        system: of J.
        recorded: of e.
        gains, parameters, noise: see `jackknife_covariance`.
    """
    size = len(gains) + len(parameters)
    grams = np.zeros((len(system.clusters), size, size))
    scores = np.zeros((len(system.clusters), size))
    left = 0.0
    for motor in range(len(gains)):
        of_clusters = [cluster[motor] for cluster in system.clusters]
        rows = np.concatenate(of_clusters)
        jacobian, residual = motor_jacobian(rows, motor, gains, parameters, noise)
        if recorded is not system:
            of_recorded = [cluster[motor] for cluster in recorded.clusters]
            recorded_rows = np.concatenate(of_recorded)
            _, residual = motor_jacobian(recorded_rows, motor, gains, parameters, noise)
        left += float(residual @ residual)
        seen = np.flatnonzero(jacobian.any(axis=0))
        seen_jacobian = jacobian[:, seen]
        ends = np.cumsum([len(of_cluster) for of_cluster in of_clusters])
        seen_grams = np.empty((len(ends), len(seen), len(seen)))
        first = 0
        for index, end in enumerate(ends.tolist()):
            cluster_jacobian = seen_jacobian[first:end]
            cluster_residual = residual[first:end]
            np.matmul(cluster_jacobian.T, cluster_jacobian, out=seen_grams[index])
            scores[index, seen] += cluster_jacobian.T @ cluster_residual
            first = end
        grams[:, seen[:, None], seen] += seen_grams
    return grams, scores, left


@dataclass(frozen=True, slots=True)
class MotorRows:
    """Rows of one motor in a problem cut into folds, sorted by fold and cluster."""

    motor: int  #: index
    rows: slice  #: among those of the problem
    #: first row of each block (the motor's rows in one cluster), counted from the motor's first,
    #: shape (blocks,)
    starts: IntArray
    fold: IntArray  #: of each block, ascending, shape (blocks,)
    cluster: IntArray  #: of each block, shape (blocks,)
    seen: IntArray  #: unknowns in the motor's equation, shape (s,)
    #: J of these, then e and r, columns first, shape (s + 2, rows); r as of `Folds.residual`
    equations: FloatArray

    def sums(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Products A_b B_bᵀ of two sets of columns over each block, shape (blocks, …, a, b).

        Args:
            first, second: columns first, shapes (…, a, rows) and (…, b, rows).
        """
        *leading, _ = first.shape
        columns = second.shape[-2]
        out = np.empty((len(self.starts), *leading, columns))
        for product, block in zip(out, self._blocks(), strict=True):
            transposed = np.swapaxes(second[..., block], -1, -2)
            np.matmul(first[..., block], transposed, out=product)
        return out

    def grams(self, columns: FloatArray) -> FloatArray:
        """Products A_b A_bᵀ over the rows of each block, shape (blocks, …, a, a); see `sums`.

        Up to MOST_SUMMED columns are multiplied by pairs on all rows and then summed block by
        block, because a matrix product for each block and candidate would be a call for a few dozen
        numbers.
        """
        count = columns.shape[-2]
        if count > MOST_SUMMED:
            return self.sums(columns, columns)
        out = np.empty((len(self.starts), *columns.shape[:-1], count))
        for row in range(count):
            for column in range(row + 1):
                product = columns[..., row, :] * columns[..., column, :]
                by_block = np.add.reduceat(product, self.starts, axis=-1)
                of_blocks = np.moveaxis(by_block, -1, 0)
                out[..., row, column] = of_blocks
                out[..., column, row] = of_blocks
        return out

    def predicted(self, steps: Sequence[FloatArray]) -> FloatArray:
        """J x_b of the motor's rows, (rows,) or (p, rows), by x_b of each block, (f,) or (p, f)."""
        jacobian = self.equations[:-2]
        parts: list[FloatArray] = []
        for step, block in zip(steps, self._blocks(), strict=True):
            own_step = step[..., self.seen]
            parts.append(own_step @ jacobian[:, block])
        return np.concatenate(parts, axis=-1)

    def _blocks(self) -> Iterator[slice]:
        """Rows of each block."""
        row_count = self.equations.shape[1]
        for start, end in pairwise((*self.starts.tolist(), row_count)):
            yield slice(start, end)

    def by_fold(self, products: FloatArray, count: int) -> FloatArray:
        """Products of each block, (blocks, …), summed over each of so many folds, (count, …)."""
        folds, first = np.unique(self.fold, return_index=True)
        out = np.zeros((count, *products.shape[1:]))
        out[folds] = np.add.reduceat(products, first, axis=0)
        return out


@dataclass(frozen=True, slots=True)
class Folds:
    """A linearised problem cut into folds of complete moves, with all that cross-validation reuses.

    A block holds the rows of one motor in one cluster; folds, clusters and motors are sums over
    blocks.
    """

    linearisation: Linearisation  #: its rows sorted by motor, fold and cluster
    #: number of complete moves distributed over the folds; a cluster may be only a piece of one
    moves: int
    blocks: tuple[tuple[slice, int, int, int], ...]  #: rows, fold, cluster and motor of each block
    motors: tuple[MotorRows, ...]  #: the same by motor, those without rows left out
    full_factor: CholeskyFactor  #: of JᵀJ
    factors: tuple[CholeskyFactor, ...]  #: the same without each fold
    scores: FloatArray  #: Jᵀe without each fold, shape (folds, f)
    cluster_hessian: FloatArray  #: JᵀJ of each cluster, shape (clusters, f, f)
    cluster_score: FloatArray  #: Jᵀe of each cluster, shape (clusters, f)
    part_hessian: FloatArray  #: JᵀJ of each fold and motor, shape (folds, m, f, f)
    part_score: FloatArray  #: Jᵀr of each fold and motor, shape (folds, m, f)
    motor_hessian: FloatArray  #: JᵀJ of each motor, shape (m, f, f)
    motor_score: FloatArray  #: Jᵀe of each motor, shape (m, f)
    #: r, the e of each row predicted by a fit that did not see its fold, shape (rows,)
    residual: FloatArray
    #: Cholesky factor of the JᵀJ of the estimate, in which rows of a run share no errors.
    estimate_factor: CholeskyFactor

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.factors)

    def square_sum(self, residual: FloatArray) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, m)."""
        rows, fold, _, motor = zip(*self.blocks, strict=True)
        starts = [block.start for block in rows]
        of_blocks = np.add.reduceat(residual**2, starts)
        total = np.zeros((self.count, len(self.linearisation.gamma)))
        np.add.at(total, (fold, motor), of_blocks)
        return total


def cut_into_folds(problem: Linearisation, move_of: IntArray | None = None) -> Folds:
    """Deal the moves out to folds in turn, so that each fold sees every run; no move is parted.

    Args:
        problem: around an estimate.
        move_of: the move that each cluster is a piece of, shape (clusters,); the clusters
            themselves when None.

    Raises:
        TooFewMoves: to leave some out.
    """
    if move_of is None:
        move_of = np.arange(problem.cluster_count)
    else:
        _, move_of = np.unique(move_of, return_inverse=True)
    moves = int(move_of.max()) + 1
    if moves < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(moves, MIN_MOVES_TO_LEAVE_OUT)
    fold_of = move_of % FOLDS
    # By motor, then fold, then cluster: the last key of lexsort is the first to count.
    order = np.lexsort((problem.cluster, fold_of[problem.cluster], problem.motor))
    orders = _orders_of_motors(problem, order)
    problem = _with_sorted_rows(problem, order, orders)
    starts = _block_starts(problem)
    by_motor = _motor_rows(problem, fold_of, starts, orders)
    sums = _sums_of(by_motor, problem)
    by_fold = sums.part_hessian.sum(axis=1)
    hessian = by_fold.sum(axis=0)
    score = sums.motor_score.sum(axis=0)
    # Two effects may be nearly equal: regularise the direction in which they differ.
    hessian[np.diag_indices_from(hessian)] *= 1.0 + RIDGE
    factors: list[CholeskyFactor] = []
    scores_without: list[FloatArray] = []
    steps: list[FloatArray] = []
    for fold in range(FOLDS):
        hessian_without = hessian - by_fold[fold]
        # A direction that only this fold sees must not explode: it stays where all the data put it.
        hessian_without[np.diag_indices_from(hessian_without)] += RIDGE * np.diag(hessian)
        factor = lower_factor(hessian_without)
        own_score = sums.cluster_score[fold_of == fold].sum(axis=0)
        score_without = score - own_score
        factors.append(factor)
        scores_without.append(score_without)
        steps.append(linalg.cho_solve(factor, score_without))
    residual = np.empty_like(problem.residual)
    part_score = np.zeros_like(sums.part_hessian[..., 0])
    for own in by_motor:
        steps_of_blocks = [steps[fold] for fold in own.fold]
        predicted = own.predicted(steps_of_blocks)
        own_residual = own.equations[-1]  # a view: r of the motor's equations is written here
        own_residual[:] = problem.residual[own.rows] - predicted
        residual[own.rows] = own_residual
        scores_of_blocks = own.sums(own.equations[:-2], own_residual[None])
        scores_of_motor = part_score[:, own.motor]  # a view, too
        scores_of_motor[:, own.seen] = own.by_fold(scores_of_blocks[..., 0], FOLDS)
    problem = _with_sorted_jacobian(problem, by_motor)
    full_factor = lower_factor(hessian)
    estimate_factor = full_factor
    if problem.scatter is not None:
        estimate_factor = _estimate_factor(problem, problem.scatter, hessian)
    return Folds(
        linearisation=problem,
        moves=moves,
        blocks=_described_blocks(problem, fold_of, starts),
        motors=tuple(by_motor),
        full_factor=full_factor,
        factors=tuple(factors),
        scores=np.stack(scores_without),
        cluster_hessian=sums.cluster_hessian,
        cluster_score=sums.cluster_score,
        part_hessian=sums.part_hessian,
        part_score=part_score,
        motor_hessian=sums.part_hessian.sum(axis=0),
        motor_score=sums.motor_score,
        residual=residual,
        estimate_factor=estimate_factor,
    )


def _orders_of_motors(problem: Linearisation, order: IntArray) -> list[IntArray]:
    """An order of all rows as one of each motor's rows, counted from its first."""
    orders: list[IntArray] = []
    for motor in range(len(problem.gamma)):
        rows = problem.rows_of(motor)
        orders.append(order[rows] - rows.start)
    return orders


def _with_sorted_rows(
    problem: Linearisation, order: IntArray, orders: Sequence[IntArray]
) -> Linearisation:
    """Sort all but the Jacobian: rows by one order, the scatter by those of each motor."""
    sorted_rows = {name: getattr(problem, name)[order] for name in LINEARISATION_ROWS}
    scatter = problem.scatter
    if scatter is not None:
        scatter = scatter.sorted(orders)
    return replace(problem, scatter=scatter, **sorted_rows)


def _block_starts(problem: Linearisation) -> IntArray:
    """First row of each block, in sorted rows: cluster or motor change there."""
    is_new_cluster = np.diff(problem.cluster, prepend=-1) != 0
    is_new_motor = np.diff(problem.motor, prepend=-1) != 0
    return np.flatnonzero(is_new_cluster | is_new_motor)


def _described_blocks(
    problem: Linearisation, fold_of: IntArray, starts: IntArray
) -> tuple[tuple[slice, int, int, int], ...]:
    """Rows, fold, cluster and motor of each block."""
    row_count = len(problem.motor)
    edges = (*starts.tolist(), row_count)
    rows = [slice(start, end) for start, end in pairwise(edges)]
    clusters = problem.cluster[starts]
    folds = fold_of[clusters].tolist()
    motors = problem.motor[starts].tolist()
    return tuple(zip(rows, folds, clusters.tolist(), motors, strict=True))


def _motor_rows(
    problem: Linearisation, fold_of: IntArray, starts: IntArray, orders: Sequence[IntArray]
) -> list[MotorRows]:
    """Sorted rows of each motor that has any; r in their equations is not filled in yet."""
    jacobian = problem.jacobian
    motor_of_block = problem.motor[starts]
    found: list[MotorRows] = []
    for motor in np.unique(motor_of_block).tolist():
        rows = problem.rows_of(motor)
        seen = jacobian.seen[motor]
        row_count = rows.stop - rows.start
        equations = np.empty((len(seen) + 2, row_count))
        own_jacobian = equations[:-2]
        np.take(jacobian.parts[motor], orders[motor], axis=1, out=own_jacobian, mode="clip")
        equations[-2] = problem.residual[rows]
        own_starts = starts[motor_of_block == motor]
        cluster = problem.cluster[own_starts]
        own = MotorRows(
            motor=motor,
            rows=rows,
            starts=own_starts - rows.start,
            fold=fold_of[cluster],
            cluster=cluster,
            seen=seen,
            equations=equations,
        )
        found.append(own)
    return found


@dataclass(frozen=True, slots=True)
class _Sums:
    """JᵀJ and Jᵀe of parts of the rows, as of `Folds`."""

    cluster_hessian: FloatArray  #: shape (clusters, f, f)
    cluster_score: FloatArray  #: shape (clusters, f)
    part_hessian: FloatArray  #: shape (folds, m, f, f)
    motor_score: FloatArray  #: shape (m, f)


def _sums_of(by_motor: Sequence[MotorRows], problem: Linearisation) -> _Sums:
    """Sums over the rows of each cluster, of each fold and motor, and of each motor."""
    clusters = problem.cluster_count
    motors = len(problem.gamma)
    width = problem.jacobian.width
    sums = _Sums(
        cluster_hessian=np.zeros((clusters, width, width)),
        cluster_score=np.zeros((clusters, width)),
        part_hessian=np.zeros((FOLDS, motors, width, width)),
        motor_score=np.zeros((motors, width)),
    )
    for own in by_motor:
        seen = own.seen
        jacobian = own.equations[:-2]
        with_residual = own.equations[:-1]
        products = own.sums(jacobian, with_residual)  # J [J | e]ᵀ of each block
        grams = products[..., :-1]
        scores = products[..., -1]
        sums.cluster_hessian[np.ix_(own.cluster, seen, seen)] += grams
        sums.cluster_score[np.ix_(own.cluster, seen)] += scores
        hessian_of_motor = sums.part_hessian[:, own.motor]  # a view
        hessian_of_motor[:, seen[:, None], seen] = own.by_fold(grams, FOLDS)
        sums.motor_score[own.motor, seen] = scores.sum(axis=0)
    return sums


def _with_sorted_jacobian(problem: Linearisation, by_motor: Sequence[MotorRows]) -> Linearisation:
    """The same with sorted rows of the Jacobian: views of the equations of each motor."""
    parts = list(problem.jacobian.parts)
    for own in by_motor:
        parts[own.motor] = own.equations[:-2]
    jacobian = replace(problem.jacobian, parts=tuple(parts))
    return replace(problem, jacobian=jacobian)


def _estimate_factor(
    problem: Linearisation, scatter: RunScatter, hessian: FloatArray
) -> CholeskyFactor:
    """Cholesky factor of J₀ᵀJ₀, with J = V^(−1/2) J₀ the decorrelated Jacobian.

    It is JᵀVJ = JᵀJ + Jᵀ(V − 1)J, and JᵀJ is known.
    """
    jacobian = problem.jacobian
    of_estimate = hessian.copy()
    for motor, (part, seen) in enumerate(zip(jacobian.parts, jacobian.seen, strict=True)):
        of_estimate[np.ix_(seen, seen)] += scatter.shared(motor, part)
    return lower_factor(of_estimate)
