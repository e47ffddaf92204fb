"""The problem around an estimate as a linear one, and everything that leaves moves out of it.

The residual of motor i is e_i = (v_i − γ_i (T τ)_i)/σ_i with the unknowns (g_1 … g_m, χ, χ_uL); see
estimators/maximum_likelihood.py. Its derivative to a gain is built from the *predicted* torque, not
from the measured current, so that the noise does not enter it. `motor_jacobian` is that derivative.
Error bars leave out one move at a time (`left_out_shifts`); the search for effects leaves out folds
of moves (`cut_into_folds`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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

LINEARISATION_ROWS = ("residual", "current", "motor", "cluster", "source")
"""Fields of a linearisation that have a number a row."""
MIN_MOVES_TO_LEAVE_OUT = 8  #: With fewer, leaving one out shows little of the scatter
FOLDS = MIN_MOVES_TO_LEAVE_OUT  #: Of moves; each holds one at least
RIDGE = 1e-10  #: Share of the diagonal of JᵀJ added to it: two effects may be nearly equal
#: Standard errors of the correlation of neighbouring clusters, above which they are joined
CORRELATED = 2.0


@dataclass(frozen=True, slots=True)
class Jacobian:
    """A matrix with the rows of all motors below each other,
    of which each holds the unknowns of its motor alone.

    The equation of a motor near the flange has few of them: less than half of the numbers of the
    whole matrix are kept.
    """

    parts: tuple[FloatArray, ...]  #: of each motor's rows, columns first, shapes (s_i, rows_i)
    seen: tuple[IntArray, ...]  #: unknowns that each motor's equation holds, shapes (s_i,)
    width: int  #: number of unknowns, f

    def __matmul__(self, step: FloatArray) -> FloatArray:
        """J x, shape (rows,), from x, shape (f,)."""
        return np.concatenate(
            [step[seen] @ part for part, seen in zip(self.parts, self.seen, strict=True)]
        )

    def columns(self, chosen: IntArray) -> FloatArray:
        """Some of its columns, shape (rows, k)."""
        own = self.only(chosen)
        parts = []
        for part, seen in zip(own.parts, own.seen, strict=True):
            parts.append(np.zeros((part.shape[1], own.width)))
            parts[-1][:, seen] = part.T
        return np.concatenate(parts)

    def only(self, chosen: IntArray) -> Jacobian:
        """A copy with some of its columns."""
        kept = [np.isin(seen, chosen) for seen in self.seen]
        return Jacobian(
            tuple(part[keep] for part, keep in zip(self.parts, kept, strict=True)),
            tuple(
                np.searchsorted(chosen, seen[keep])
                for seen, keep in zip(self.seen, kept, strict=True)
            ),
            len(chosen),
        )

    def on_columns(self, columns: FloatArray) -> FloatArray:
        """JᵀΦ, shape (f, …), from columns on all rows, shape (rows, …)."""
        out = np.zeros((self.width, *columns.shape[1:]))
        ends = np.cumsum([part.shape[1] for part in self.parts])
        for part, seen, own in zip(
            self.parts, self.seen, np.split(columns, ends[:-1]), strict=True
        ):
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

    jacobian: Jacobian  #: ∂(γ (T τ)/σ) per unit of each free unknown in its own scale
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
    #: where it is D⁻¹.
    transform: FloatArray | None = None
    #: Errors that the rows of a run share, and that the rows are decorrelated from; None where
    #: there are none.
    scatter: RunScatter | None = None

    @property
    def cluster_count(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

    def of_clusters(self, per_row: IntArray) -> IntArray:
        """Each cluster's number, shape (clusters,), of numbers of the observation's rows that
        clusters do not part.
        """
        return per_row[self.source[np.unique(self.cluster, return_index=True)[1]]]

    def rows_of(self, motor: int) -> slice:
        """Rows of one motor."""
        first, last = np.searchsorted(self.motor, (motor, motor + 1))
        return slice(int(first), int(last))

    def shown(self, motor: int) -> float:
        """Σ P_ii over a motor's rows: their number, less what internal preload hides of the
        current's noise.
        """
        rows = self.rows_of(motor)
        if self.transform is None:
            return float(rows.stop - rows.start)
        passed = self.transform[self.source[rows], motor, motor]
        return float(passed.sum() * self.noise[motor] / self.gamma[motor])

    def felt(self, torque_nm: FloatArray, to_motor: FloatArray) -> dict[int, FloatArray]:
        """Joint torque columns, shape (m, extra, r), whitened,
        on the rows of each motor that feels any: (extra, rows).

        Args:
            torque_nm: per unit of each column.
            to_motor: T (DriveTrain.to_motor).
        """
        return self.decorrelated_by_motor([self.whitened_by_motor(torque_nm, to_motor)])[0]

    def whitened_by_motor(
        self, torque_nm: FloatArray, to_motor: FloatArray
    ) -> dict[int, FloatArray]:
        """The same with what runs share still in the columns; see `decorrelated_by_motor`."""
        felt: dict[int, FloatArray] = {}
        if self.transform is not None:
            for motor in range(len(self.gamma)):
                source = self.source[self.rows_of(motor)]
                torque = torque_nm.take(source, axis=2)
                felt[motor] = np.einsum("rj,jer->er", self.transform[source, motor], torque)
            return felt
        for joint in np.flatnonzero(torque_nm.any(axis=(1, 2))):
            for motor in np.flatnonzero(to_motor[:, joint]).tolist():
                own = torque_nm[joint].take(self.source[self.rows_of(motor)], axis=1)
                own *= to_motor[motor, joint] * self.gamma[motor] / self.noise[motor]
                felt[motor] = felt[motor] + own if motor in felt else own
        return felt

    def decorrelated_by_motor(
        self, each: Sequence[dict[int, FloatArray]]
    ) -> list[dict[int, FloatArray]]:
        """Take out of whitened columns what the rows of a run share;
        all together, because that is faster.

        Args:
            each: columns on the rows of each motor that feels any, of some candidates, shapes
                (extra, rows).
        """
        if self.scatter is None:
            return list(each)
        found: list[dict[int, FloatArray]] = [{} for _ in each]
        for motor in range(len(self.gamma)):
            feeling = [number for number, one in enumerate(each) if motor in one]
            if not feeling:
                continue
            columns = [each[number][motor] for number in feeling]
            ends = np.cumsum([len(own) for own in columns])
            parts = np.split(self.scatter.decorrelate(motor, np.concatenate(columns)), ends[:-1])
            for number, part in zip(feeling, parts, strict=True):
                found[number][motor] = part
        return found

    def beside_scatter(
        self, torque_nm: FloatArray, to_motor: FloatArray, run: IntArray
    ) -> Linearisation:
        """The same problem where the rows of a run share errors, decorrelated from these;
        the unknowns stay.

        Args:
            torque_nm: of one standard deviation of each error, shape (m, k, r).
            to_motor: T (DriveTrain.to_motor).
            run: of each of the observation's rows, shape (r,).
        """
        motors = range(len(self.gamma))
        whole = self.whitened(torque_nm, to_motor).T
        rows = [self.rows_of(motor) for motor in motors]
        scatter = RunScatter.of(
            [whole[:, own] for own in rows], [run[self.source[own]] for own in rows]
        )
        parts = tuple(scatter.decorrelate(motor, self.jacobian.parts[motor]) for motor in motors)
        residual = [
            scatter.decorrelate(motor, self.residual[None, own])[0]
            for motor, own in enumerate(rows)
        ]
        return replace(
            self,
            jacobian=replace(self.jacobian, parts=parts),
            residual=np.concatenate(residual),
            scatter=scatter,
        )

    def fitted(self) -> tuple[Linearisation, FloatArray]:
        """The same around the best fit of its rows, and the step to it, shape (f,),
        in the scale of the unknowns.
        """
        hessian = sum_of_squares(self.jacobian)
        hessian[np.diag_indices_from(hessian)] *= 1.0 + RIDGE
        step = linalg.cho_solve(
            linalg.cho_factor(hessian, lower=True), self.jacobian.on_columns(self.residual)
        )
        return replace(self, residual=self.residual - self.jacobian @ step), step

    def decorrelated(self, columns: FloatArray) -> FloatArray:
        """V^(−1/2) times columns, shape (rows,);
        the columns themselves where runs share no errors.
        """
        if self.scatter is None:
            return columns
        parts = [
            self.scatter.decorrelate(motor, columns[None, self.rows_of(motor)])[0]
            for motor in range(len(self.gamma))
        ]
        return np.concatenate(parts)

    def correlated(self, columns: FloatArray) -> FloatArray:
        """V times decorrelated columns, shape (rows,);
        the columns themselves where runs share no errors.
        """
        if self.scatter is None:
            return columns
        parts = [
            self.scatter.correlate(motor, columns[None, self.rows_of(motor)])[0]
            for motor in range(len(self.gamma))
        ]
        return np.concatenate(parts)

    def whitened(self, torque_nm: FloatArray, to_motor: FloatArray) -> FloatArray:
        """The same as columns beside the Jacobian, shape (rows, extra)."""
        columns = np.zeros((torque_nm.shape[1], len(self.motor)))
        for motor, own in self.felt(torque_nm, to_motor).items():
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
    """Linearise around given gains [Nm/A], parameters and current noise [A] of each motor."""
    count, width = len(gains), len(gains) + len(parameters)
    first = count if gains_fixed else 0
    used = [np.flatnonzero(use) for use in observation.motor_use]
    parts: list[FloatArray] = []
    seen: list[IntArray] = []
    residual, current, squares = [], [], np.zeros(width)
    rows_of = (
        columns[:, rows].T for columns, rows in zip(observation.motor_columns(), used, strict=True)
    )
    preload = observation.preload[:, :, used[0]].transpose(2, 0, 1)
    for whole, left, measured in motor_jacobians(rows_of, preload, gains, parameters, noise):
        squares += np.einsum("rf,rf->f", whole, whole)
        seen.append(np.flatnonzero(whole[:, first:].any(axis=0)))
        parts.append(np.ascontiguousarray(whole[:, first + seen[-1]].T))
        residual.append(left)
        current.append(measured)
    norms = np.sqrt(squares[count:])
    unit = np.concatenate(
        (gains, np.divide(1.0, norms, where=norms > 0, out=np.ones(len(parameters))))
    )[first:]
    for part, held in zip(parts, seen, strict=True):
        np.multiply(part, unit[held, None], out=part)
    source = np.concatenate(used)
    return Linearisation(
        jacobian=Jacobian(tuple(parts), tuple(seen), width - first),
        residual=np.concatenate(residual),
        current=np.concatenate(current),
        motor=np.repeat(np.arange(count), [len(rows) for rows in used]),
        cluster=np.unique(observation.move[source], return_inverse=True)[1].astype(np.int64),
        source=source,
        gamma=1.0 / gains,
        noise=noise,
        free=np.arange(first, width),
        scale=unit,
        transform=whitening_transform(observation.preload.transpose(2, 0, 1), gains, noise)
        if preload.size
        else None,
    )


def motor_jacobians(
    rows: Iterable[FloatArray],
    preload: FloatArray,
    gains: FloatArray,
    parameters: FloatArray,
    noise: FloatArray,
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """J, e and the measured current in units of its noise, of each motor's equations in turn.

    Args:
        rows: of each motor, see `motor_jacobian`; with preload [V_i | …] of all of them alike.
        preload: N of the rows, shape (r, m, m − d).
        gains, parameters, noise: see `motor_jacobian`.
    """
    if not preload.size:
        for motor, own in enumerate(rows):
            yield *motor_jacobian(own, motor, gains, parameters, noise), own[:, 0] / noise[motor]
        return
    currents = PreloadedCurrents.of_rows(list(rows), preload)
    whitened = currents.whitened(gains, noise)
    residual = whitened.residual(gains, parameters)
    jacobian = np.concatenate(
        (-currents.corrected(gains, noise, whitened, residual), whitened.linear), axis=1
    )
    parts = (np.split(part, len(gains)) for part in (jacobian, residual, whitened.drive @ gains))
    yield from zip(*parts, strict=True)


def motor_jacobian(
    rows: FloatArray, motor: int, gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """J = ∂(γ_i (T τ)_i/σ_i)/∂(g, χ, χ_uL) and e of one motor's equations, shapes (r, m + p)
    and (r,).

    Args:
        rows: [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], or the triangle of these, which has the
            same JᵀJ and Jᵀe.
        motor: i.
        gains, parameters: where to linearise.
        noise: σ of each motor's current [A].
    """
    count = len(gains)
    torque = rows[:, 1:-1] @ parameters + rows[:, -1]
    scale = 1.0 / (gains[motor] * noise[motor])
    jacobian = np.zeros((len(rows), count + len(parameters)))
    jacobian[:, motor] = -scale / gains[motor] * torque  # ∂(γ τ)/∂g = −γ² τ
    jacobian[:, count:] = scale * rows[:, 1:-1]
    return jacobian, rows[:, 0] / noise[motor] - scale * torque


def left_out_shifts(grams: FloatArray, scores: FloatArray) -> FloatArray:
    """Shift of the unknowns when each cluster is left out, d_c = −(H − G_c)⁻¹ s_c with H = Σ G_c,
    shape (C, f).

    Args:
        grams: G_c = J_cᵀJ_c of each cluster, shape (C, f, f).
        scores: s_c = J_cᵀe_c around the estimate, where they sum to zero, shape (C, f).
    """
    hessian = grams.sum(axis=0)
    # In units in which every unknown is seen equally well: kilograms are beside kg m².
    unit = 1.0 / np.sqrt(np.where(np.diag(hessian) > 0.0, np.diag(hessian), 1.0))
    rest = (hessian - grams) * np.outer(unit, unit)
    return -np.stack(
        [_solved(matrix, score * unit) * unit for matrix, score in zip(rest, scores, strict=True)]
    )


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix, lower=True), right))
    except linalg.LinAlgError:  # a direction that only the cluster left out has seen
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def scatter_of(shifts: FloatArray) -> FloatArray:
    """Jackknife covariance (C − 1)/C Σ (d_c − mean)(d_c − mean)ᵀ, shape (f, f), of C shifts d_c,
    shape (C, f).
    """
    centred = shifts - shifts.mean(axis=0)
    return np.asarray((len(shifts) - 1) / len(shifts) * (centred.T @ centred))


def independent_blocks(grams: FloatArray, scores: FloatArray, runs: IntArray) -> IntArray:
    """Join neighbouring clusters of a run in pairs, again and again,
    until they are independent of each other.

    Clusters are moves, and pieces of 2 s of longer moves: long beside the noise of drives, but not
    beside every misfit of a model. The correlation of neighbours, in units in which all unknowns
    are known equally well, is

        r = Σ z_cᵀz_c₊₁ / Σ z_cᵀz_c,      z = L⁻¹ s,      L Lᵀ = H,

    and its standard error is the root of Σ (z_cᵀz_c₊₁)² over the same sum; that of independent
    clusters is a little below zero, because all scores together are zero. Blocks become longer
    until r no longer shows (batch means: Fishman 1978).

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
    unit = 1.0 / np.sqrt(np.where(np.diag(hessian) > 0.0, np.diag(hessian), 1.0))
    scaled = hessian * np.outer(unit, unit)
    scaled[np.diag_indices_from(scaled)] += 1e-9  # a direction that no row shows
    lower = np.linalg.cholesky(scaled)
    while True:
        z = linalg.solve_triangular(lower, (scores * unit).T, lower=True).T
        products = np.sum(z[1:] * z[:-1], axis=1)[runs[1:] == runs[:-1]]
        if float(products.sum()) <= CORRELATED * float(np.linalg.norm(products)):
            return starts
        first = np.sort(
            np.concatenate([np.flatnonzero(runs == run)[::2] for run in np.unique(runs)])
        )
        if len(first) < MIN_MOVES_TO_LEAVE_OUT:
            return starts
        starts, scores, runs = starts[first], np.add.reduceat(scores, first), runs[first]


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
        recorded: equations whose residuals count, where those of ``system`` are projected on
            instruments.

    Returns:
        shape (m + p, m + p).

    Raises:
        TooFewMoves: fewer than MIN_MOVES_TO_LEAVE_OUT.
    """
    clusters, count, size = len(system.clusters), len(gains), len(gains) + len(parameters)
    if clusters < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(clusters, MIN_MOVES_TO_LEAVE_OUT)
    free = slice(count if gains_fixed else 0, size)
    grams, scores = np.zeros((clusters, size, size)), np.zeros((clusters, size))
    for index, (cluster, own) in enumerate(
        zip(system.clusters, (recorded or system).clusters, strict=True)
    ):
        equations = motor_jacobians(cluster, system.preload_of(index), gains, parameters, noise)
        for motor, (jacobian, left, _) in enumerate(equations):
            same = own[motor] is cluster[motor]
            residual = (
                left if same else motor_jacobian(own[motor], motor, gains, parameters, noise)[1]
            )
            grams[index] += jacobian.T @ jacobian
            scores[index] += jacobian.T @ residual
    runs = np.array([run for run, _ in system.cluster_runs])
    grams, scores = grams[:, free, free], scores[:, free]
    starts = independent_blocks(grams, scores, runs)
    covariance = np.zeros((size, size))
    covariance[free, free] = scatter_of(
        left_out_shifts(np.add.reduceat(grams, starts), np.add.reduceat(scores, starts))
    )
    return covariance


@dataclass(frozen=True, slots=True)
class MotorRows:
    """Rows of one motor in a problem cut into folds:
    they follow each other, sorted by fold and cluster.
    """

    motor: int  #: index
    rows: slice  #: among those of the problem
    starts: IntArray  #: first row of each block, counted from the motor's first, shape (blocks,)
    fold: IntArray  #: of each block, ascending, shape (blocks,)
    cluster: IntArray  #: of each block, shape (blocks,)
    seen: IntArray  #: unknowns that the motor's equation holds, shape (s,)
    equations: FloatArray  #: J of these, e and r, columns first, shape (s + 2, rows)

    def sums(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Products A_b B_bᵀ of two sets of columns over the rows of each block, shape (blocks, …,
        a, b).

        Args:
            first, second: columns first, shapes (…, a, rows) and (…, b, rows).
        """
        out = np.empty((len(self.starts), *first.shape[:-1], second.shape[-2]))
        for product, start, stop in zip(
            out, self.starts, (*self.starts[1:], first.shape[-1]), strict=True
        ):
            np.matmul(
                first[..., start:stop], np.swapaxes(second[..., start:stop], -1, -2), out=product
            )
        return out

    def predicted(self, steps: Sequence[FloatArray]) -> FloatArray:
        """J x of the motor's rows, shape (rows,) or (p, rows), with an x of each block, shape (f,)
        or (p, f).
        """
        ends = (*self.starts[1:], self.equations.shape[1])
        blocks = zip(steps, self.starts, ends, strict=True)
        return np.concatenate(
            [x[..., self.seen] @ self.equations[:-2, a:b] for x, a, b in blocks], axis=-1
        )

    def by_fold(self, products: FloatArray, count: int) -> FloatArray:
        """Products of each block, shape (blocks, …), summed over each of so many folds,
        shape (count, …).
        """
        folds, first = np.unique(self.fold, return_index=True)
        out = np.zeros((count, *products.shape[1:]))
        out[folds] = np.add.reduceat(products, first, axis=0)
        return out


@dataclass(frozen=True, slots=True)
class Folds:
    """A linearised problem cut into folds of whole moves,
    with everything that cross-validation reuses.

    A block holds the rows of one motor in one cluster; folds, clusters and motors are sums over
    blocks.
    """

    linearisation: Linearisation  #: its rows sorted by motor, fold and cluster
    #: number of whole moves distributed over the folds; a cluster may be only a piece of one
    moves: int
    blocks: tuple[tuple[slice, int, int, int], ...]  #: rows, fold, cluster and motor of each block
    motors: tuple[MotorRows, ...]  #: the same by motor, those without rows left out
    full_factor: tuple[FloatArray, bool]  #: Cholesky factor of JᵀJ, with scipy's flag
    factors: tuple[tuple[FloatArray, bool], ...]  #: the same without each fold
    scores: FloatArray  #: Jᵀe without each fold, shape (folds, f)
    cluster_hessian: FloatArray  #: JᵀJ of each cluster, shape (clusters, f, f)
    cluster_score: FloatArray  #: Jᵀe of each cluster, shape (clusters, f)
    part_hessian: FloatArray  #: JᵀJ of each fold and motor, shape (folds, m, f, f)
    part_score: FloatArray  #: Jᵀr of each fold and motor, shape (folds, m, f)
    motor_score: FloatArray  #: Jᵀe of each motor, shape (m, f)
    #: r, the e of each row predicted by a fit that did not see its fold, shape (rows,)
    residual: FloatArray
    #: Cholesky factor of the JᵀJ of the estimate, in which rows of a run share no errors.
    estimate_factor: tuple[FloatArray, bool]

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.factors)

    def square_sum(self, residual: FloatArray) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, m)."""
        rows, fold, _, motor = zip(*self.blocks, strict=True)
        total = np.zeros((self.count, len(self.linearisation.gamma)))
        np.add.at(total, (fold, motor), np.add.reduceat(residual**2, [part.start for part in rows]))
        return total


def cut_into_folds(problem: Linearisation, move_of: IntArray | None = None) -> Folds:
    """Deal the moves out to folds in turn, so that every fold sees every run;
    a move is never parted.

    Args:
        problem: around an estimate.
        move_of: the move that each cluster is a piece of, shape (clusters,); the clusters
            themselves when None.

    Raises:
        TooFewMoves: to leave some out.
    """
    move_of = (
        np.arange(problem.cluster_count)
        if move_of is None
        else np.unique(move_of, return_inverse=True)[1]
    )
    moves = int(move_of.max()) + 1
    if moves < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(moves, MIN_MOVES_TO_LEAVE_OUT)
    fold_of = move_of % FOLDS
    motors, jacobian, width = len(problem.gamma), problem.jacobian, problem.jacobian.width
    order = np.lexsort((problem.cluster, fold_of[problem.cluster], problem.motor))
    orders = [
        order[problem.rows_of(motor)] - problem.rows_of(motor).start for motor in range(motors)
    ]
    problem = _with_sorted_rows(problem, order, orders)
    scatter = problem.scatter
    change = (np.diff(problem.cluster, prepend=-1) != 0) | (np.diff(problem.motor, prepend=-1) != 0)
    starts = np.flatnonzero(change)
    rows_of = (slice(int(a), int(b)) for a, b in pairwise((*starts, len(problem.motor))))
    cluster, motor = problem.cluster[starts], problem.motor[starts]
    blocks = tuple(
        zip(rows_of, fold_of[cluster].tolist(), cluster.tolist(), motor.tolist(), strict=True)
    )
    cluster_hessian = np.zeros((problem.cluster_count, width, width))
    cluster_score = np.zeros((problem.cluster_count, width))
    part_hessian, motor_score = np.zeros((FOLDS, motors, width, width)), np.zeros((motors, width))
    by_motor, sorted_parts = [], list(jacobian.parts)
    for i in np.unique(motor):
        here, whole, seen = motor == i, problem.rows_of(int(i)), jacobian.seen[i]
        equations = np.empty((len(seen) + 2, whole.stop - whole.start))
        np.take(jacobian.parts[i], orders[i], axis=1, out=equations[:-2], mode="clip")
        sorted_parts[i], equations[-2] = equations[:-2], problem.residual[whole]
        own = MotorRows(
            int(i),
            whole,
            starts[here] - whole.start,
            fold_of[cluster[here]],
            cluster[here],
            seen,
            equations,
        )
        by_motor.append(own)
        products = own.sums(equations[:-2], equations[:-1])
        grams, scores = products[..., :-1], products[..., -1]
        cluster_hessian[np.ix_(own.cluster, seen, seen)] += grams
        cluster_score[np.ix_(own.cluster, seen)] += scores
        part_hessian[:, i][:, seen[:, None], seen] = own.by_fold(grams, FOLDS)
        motor_score[i, seen] = scores.sum(axis=0)
    by_fold = part_hessian.sum(axis=1)
    hessian, score = by_fold.sum(axis=0), motor_score.sum(axis=0)
    # Two effects may be nearly equal: regularise the direction in which they differ.
    hessian[np.diag_indices_from(hessian)] *= 1.0 + RIDGE
    factors, scores_without = [], []
    for k in range(FOLDS):
        rest = hessian - by_fold[k]
        # A direction that only this fold sees must not explode: it stays where the whole data put
        # it.
        rest[np.diag_indices_from(rest)] += RIDGE * np.diag(hessian)
        factors.append(linalg.cho_factor(rest, lower=True))
        scores_without.append(score - cluster_score[fold_of == k].sum(axis=0))
    steps = [
        linalg.cho_solve(factor, part) for factor, part in zip(factors, scores_without, strict=True)
    ]
    residual = np.empty_like(problem.residual)
    part_score = np.zeros((FOLDS, motors, width))
    for own in by_motor:
        left = own.equations[-1]
        left[:] = problem.residual[own.rows] - own.predicted([steps[k] for k in own.fold])
        residual[own.rows] = left
        parts = own.by_fold(own.sums(own.equations[:-2], left[None])[..., 0], FOLDS)
        part_score[:, own.motor][:, own.seen] = parts
    # Held once, by MotorRows
    problem = replace(problem, jacobian=replace(jacobian, parts=tuple(sorted_parts)))
    full_factor = (linalg.cho_factor(hessian, lower=True)[0], True)
    return Folds(
        linearisation=problem,
        moves=moves,
        blocks=blocks,
        motors=tuple(by_motor),
        full_factor=full_factor,
        factors=tuple(factors),
        scores=np.stack(scores_without),
        cluster_hessian=cluster_hessian,
        cluster_score=cluster_score,
        part_hessian=part_hessian,
        part_score=part_score,
        motor_score=motor_score,
        residual=residual,
        estimate_factor=full_factor
        if scatter is None
        else _estimate_factor(problem, scatter, hessian),
    )


def _with_sorted_rows(
    problem: Linearisation, order: IntArray, orders: Sequence[IntArray]
) -> Linearisation:
    """Sort everything but the Jacobian:
    all rows by one order, the scatter by those of each motor.
    """
    sorted_rows = {name: getattr(problem, name)[order] for name in LINEARISATION_ROWS}
    scatter = None if problem.scatter is None else problem.scatter.sorted(orders)
    return replace(problem, scatter=scatter, **sorted_rows)


def _estimate_factor(
    problem: Linearisation, scatter: RunScatter, hessian: FloatArray
) -> tuple[FloatArray, bool]:
    """Cholesky factor of J₀ᵀJ₀ = JᵀVJ, J = V^(−1/2) J₀ being the decorrelated Jacobian,
    from JᵀJ.
    """
    whole = hessian.copy()
    for motor, (part, seen) in enumerate(
        zip(problem.jacobian.parts, problem.jacobian.seen, strict=True)
    ):
        whole[np.ix_(seen, seen)] += scatter.shared(motor, part)
    return linalg.cho_factor(whole, lower=True)[0], True
