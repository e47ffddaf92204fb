"""One step of the equations of motion with dry friction that really sticks.

With M the inertia of the links, P the motors' directions (τ = Pᵀ τ_m, Ia and motor friction act
along its rows) and h the step:

    A = M + Pᵀ diag(Ia + h Fv_m) P + h diag(Fv),     A v_free = (M + Pᵀ diag(Ia) P) v + h (Pᵀ τ_m + τ − c(q, q̇)),

that is semi-implicit Euler with implicit viscous friction; dry friction adds A⁻¹ Dᵀ λ. Along each
direction d_k (a joint, or a motor that turns with several joints) it gives an impulse λ_k with

    |λ_k| ≤ b_k,     w_k > 0 ⇒ λ_k = −b_k,     w_k < 0 ⇒ λ_k = +b_k,     w = w_free + W λ,     W = D A⁻¹ Dᵀ,

where w = D v⁺ are the speeds at the end of the step and b_k is the bound [Nm] times the step [s].
This is the optimality condition of the convex problem min ½ λᵀ W λ + w_freeᵀ λ over the box |λ| ≤
b, so v⁺ is unique even where λ is not (dependent directions, eq. 25 of the seed paper), and no
smoothing constant enters.

In a closed chain the speeds are v⁺ = G x, G the basis of the speeds that its closures allow. That
is the same step with Gᵀ A G, Gᵀ of the right side and D G in place of A, the right side and D: the
impulses of the closures, of any size, drop out exactly, however many of them are redundant.
Directions depend on each other then (a passive joint turns with the motors), which the solver is
made for.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np

from drivers.simulation.spec import BoolArray, FloatArray, IntArray

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile with numba, cached next to the function's file or in NUMBA_CACHE_DIR.

    numba invalidates a cached function when its own file changes, not when a function it calls in
    another file does: so compiled functions call only compiled functions of their own file.

    They loop over numbers instead of arrays, and take no optional arguments: an expression of
    arrays compiles numba's own functions with it, each second of which a new machine waits for at
    its first simulated cell.
    """
    return cast(F, numba.njit(cache=True)(function))


#: Largest speed that a direction may keep while its friction is inside its bound [rad/s]
TOLERANCE_RAD_S = 1e-10
MAX_SWEEPS = 2_000
#: Sweeps that find which directions stick, before these are solved for directly
SWEEPS_A_ROUND = 10
DEPENDENT = 1e-9  #: Relative pivot below which a sticking direction depends on those before it
#: The same in a closed chain, where joints turn nearly alike close to a symmetric pose
DEPENDENT_CLOSED = 1e-13
#: Speed that a direction of a closed chain may keep in addition, over the largest speed
TOLERANCE_CLOSED = 1e-6
IMMOBILE = 1e-14  #: Relative mobility below which the closures of a closed chain hold a direction
SPANNED = 1e-6  #: Sine of the angle below which a direction lies in the span of others


class Mechanics(NamedTuple):
    """Constants of a plant with n motors, N coordinates and m directions of dry friction.

    The coordinates are the n joints, then each motor behind a flexible drive.
    """

    motor_direction: FloatArray  #: P, how each motor turns with the coordinates, shape (n, N)
    rotor_direction: FloatArray  #: the same for its rotor, shape (n, N)
    motor_inertia: FloatArray  #: Ia along the rows of P, shape (n,)
    motor_viscous: FloatArray  #: Fv_m along the rows of P, shape (n,)
    directions: FloatArray  #: D of dry friction, shape (m, N); the first n are the joints
    own_row: IntArray  #: direction that carries each motor's own dry friction and brake, shape (n,)
    lone: IntArray  #: coordinate of each direction that has only one, else -1, shape (m,)
    step_s: float  #: h


@compiled
def advance(
    constants: tuple[Any, ...],
    mass: FloatArray,
    bias: FloatArray,
    viscous: FloatArray,
    motor_torque: FloatArray,
    torque: FloatArray,
    bound: FloatArray,
    impulse: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    load_torque: FloatArray,
) -> float:
    """Advance by one step unless dry friction stays unsolved; return its certificate [rad/s].

    A direction whose friction is inside its bound sticks: the solver left it at most its tolerance
    of speed. Where that pins a coordinate, its speed becomes exactly zero here, so that a resting
    axis does not creep.

    Args:
        constants: of the plant, its Mechanics as a plain tuple, which numba recognises faster.
        mass, bias: M and c of the links, shapes (n, n) and (n,); the coordinates after the n-th
            have no link.
        viscous, torque: on each coordinate, shape (N,).
        motor_torque: along the rows of P, shape (n,).
        bound: largest impulse of each direction [Nm s], shape (m,).
        impulse: λ, of the step before and then of this one, shape (m,).
        position, velocity: state, changed in place, shape (N,).
        load_torque: torque of the links on each joint, M a + c(q, q̇) [Nm], shape (n,), output.
    """
    mechanics = Mechanics(*constants)
    directions = mechanics.directions
    step_s = mechanics.step_s
    inertia, after = _assemble(mechanics, mass, bias, viscous, motor_torque, torque, velocity)
    _factorise(inertia)
    _substitute(inertia, after)
    response, free_speed, delassus = _respond(inertia, after, directions)
    residual = solve(delassus, free_speed, bound, impulse, TOLERANCE_RAD_S, MAX_SWEEPS, DEPENDENT)
    if not residual <= TOLERANCE_RAD_S:
        return residual
    _add_times(response, impulse, after)
    change = np.empty(len(velocity))
    resting = _resting(impulse, bound, directions, mechanics.lone)
    for i in range(len(velocity)):
        # Written so that v + change is exactly zero.
        if resting[i]:
            change[i] = -velocity[i]
        else:
            change[i] = after[i] - velocity[i]
    for i in range(len(bias)):
        load_torque[i] = bias[i]
        for j in range(len(bias)):
            load_torque[i] += mass[i, j] * change[j] / step_s
    for i in range(len(velocity)):
        velocity[i] += change[i]
        position[i] += step_s * velocity[i]
    return residual


@compiled
def turn_rotors(rotor_direction: FloatArray, position: FloatArray, motor_rad: FloatArray) -> None:
    """Compute the rotor angles at the end of a step, shape (m,), output, from the positions,
    shape (N,).
    """
    motor_rad[:] = 0.0
    _add_times(rotor_direction, position, motor_rad)


@compiled
def advance_closed(
    constants: tuple[Any, ...],
    mass: FloatArray,
    bias: FloatArray,
    viscous: FloatArray,
    motor_torque: FloatArray,
    torque: FloatArray,
    bound: FloatArray,
    impulse: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    load_torque: FloatArray,
    basis: FloatArray,
    resting: BoolArray,
) -> float:
    """Advance a closed chain as `advance` does;
    the positions still have to be settled on its closures.

    Args:
        constants, mass, bias, viscous, motor_torque, torque, bound, impulse, position, velocity: as
            for `advance`.
        load_torque: torque that passes from each joint to the links [Nm], shape (n,), output.
        basis: G at the position, shape (n, d).
        resting: coordinates whose speed became exactly zero, shape (N,), output.

    Returns:
        zero, or the certificate of a step that was not done.
    """
    mechanics = Mechanics(*constants)
    n, d = basis.shape
    total = len(velocity)
    inertia, momentum = _assemble(mechanics, mass, bias, viscous, motor_torque, torque, velocity)
    whole = np.zeros((total, d + total - n))
    for i in range(n):
        for j in range(d):
            whole[i, j] = basis[i, j]
    for i in range(total - n):
        whole[n + i, d + i] = 1.0
    reduced = _product(whole.T, _product(inertia, whole))
    free = _times(whole.T, momentum)
    directions = _product(mechanics.directions, whole)
    _factorise(reduced)
    _substitute(reduced, free)
    response, free_speed, delassus = _respond(reduced, free, directions)
    _leave_out_immobile(delassus, free_speed, impulse, directions, response)
    # Of two joints that turn alike but for 1e-8, one may slide while the other still sticks: too
    # fine to solve for.
    largest = 0.0
    for k in range(len(free_speed)):
        largest = max(largest, abs(free_speed[k]))
    tolerance = TOLERANCE_RAD_S + TOLERANCE_CLOSED * largest
    residual = solve(delassus, free_speed, bound, impulse, tolerance, MAX_SWEEPS, DEPENDENT_CLOSED)
    if not residual <= tolerance:
        return residual
    change = _times(response, impulse)
    for i in range(len(free)):
        free[i] += change[i]
    after = _times(whole, free)
    _resting_closed(impulse, bound, directions, mechanics.lone, resting)
    for i in range(total):
        if resting[i]:
            after[i] = 0.0
    _pass_on(mechanics, viscous, motor_torque, torque, impulse, velocity, after, load_torque)
    for i in range(total):
        velocity[i] = after[i]
        position[i] += mechanics.step_s * after[i]
    return 0.0


@compiled
def _leave_out_immobile(
    delassus: FloatArray,
    free_speed: FloatArray,
    impulse: FloatArray,
    directions: FloatArray,
    response: FloatArray,
) -> None:
    """Leave out the directions that the closures hold:
    any impulse is a solution there, and none does anything.
    """
    largest = 0.0
    for k in range(len(impulse)):
        largest = max(largest, delassus[k, k])
    for k in range(len(impulse)):
        if delassus[k, k] <= IMMOBILE * largest:
            delassus[k, :] = 0.0
            delassus[:, k] = 0.0
            delassus[k, k] = 1.0
            free_speed[k] = impulse[k] = 0.0
            directions[k] = 0.0
            response[:, k] = 0.0


@compiled
def _pass_on(
    mechanics: Mechanics,
    viscous: FloatArray,
    motor_torque: FloatArray,
    torque: FloatArray,
    impulse: FloatArray,
    before: FloatArray,
    after: FloatArray,
    load_torque: FloatArray,
) -> None:
    """Compute what each joint passes to the links in a step:
    torques less rotors and friction, λ with them.
    """
    step_s = mechanics.step_s
    for i in range(len(load_torque)):
        load_torque[i] = torque[i] - viscous[i] * after[i]
        for k in range(len(impulse)):
            load_torque[i] += mechanics.directions[k, i] * impulse[k] / step_s
    for k in range(len(motor_torque)):
        given = motor_torque[k]
        for j in range(len(after)):
            rotor = (
                mechanics.motor_inertia[k] * (after[j] - before[j]) / step_s
                + mechanics.motor_viscous[k] * after[j]
            )
            given -= mechanics.motor_direction[k, j] * rotor
        for i in range(len(load_torque)):
            load_torque[i] += mechanics.motor_direction[k, i] * given


@compiled
def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return left · right; for these sizes faster than a library call."""
    product = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            if left[i, k] != 0.0:
                for j in range(right.shape[1]):
                    product[i, j] += left[i, k] * right[k, j]
    return product


@compiled
def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return matrix · vector."""
    product = np.zeros(matrix.shape[0])
    _add_times(matrix, vector, product)
    return product


@compiled
def _add_times(matrix: FloatArray, vector: FloatArray, total: FloatArray) -> None:
    """Add matrix · vector to the first numbers of a total."""
    for i in range(matrix.shape[0]):
        for k in range(matrix.shape[1]):
            total[i] += matrix[i, k] * vector[k]


@compiled
def _resting_closed(
    impulse: FloatArray,
    bound: FloatArray,
    directions: FloatArray,
    lone: IntArray,
    resting: BoolArray,
) -> None:
    """Find the coordinates at rest: all where the sticking directions span the speeds,
    else those that stick alone.
    """
    size = directions.shape[1]
    span = np.zeros((size, size))
    rest = np.empty(size)
    rank = 0
    resting[:] = False
    for k in range(len(impulse)):
        length = _length(directions[k])
        if abs(impulse[k]) >= bound[k] or length == 0.0:
            continue
        if lone[k] >= 0:
            resting[lone[k]] = True
        if rank == size:
            continue
        for j in range(size):
            rest[j] = directions[k, j] / length
        # Gram-Schmidt, twice for rounding.
        for _ in range(2):
            for i in range(rank):
                along = 0.0
                for j in range(size):
                    along += span[i, j] * rest[j]
                for j in range(size):
                    rest[j] -= along * span[i, j]
        length = _length(rest)
        if length > SPANNED:
            for j in range(size):
                span[rank, j] = rest[j] / length
            rank += 1
    if rank == size:
        resting[:] = True


@compiled
def _length(vector: FloatArray) -> float:
    """Return the Euclidean length."""
    s = 0.0
    for j in range(len(vector)):
        s += vector[j] * vector[j]
    return float(np.sqrt(s))


@compiled
def _assemble(
    mechanics: Mechanics,
    mass: FloatArray,
    bias: FloatArray,
    viscous: FloatArray,
    motor_torque: FloatArray,
    torque: FloatArray,
    velocity: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return A, shape (N, N), and the right side of A v_free, shape (N,)."""
    direction = mechanics.motor_direction
    step_s = mechanics.step_s
    total = len(velocity)
    inertia = np.zeros((total, total))
    momentum = np.zeros(total)
    _add_times(mass, velocity, momentum)
    for i in range(len(bias)):
        for j in range(len(bias)):
            inertia[i, j] = mass[i, j]
        momentum[i] -= step_s * bias[i]
    for i in range(total):
        momentum[i] += step_s * torque[i]
        inertia[i, i] += step_s * viscous[i]
    speed = _times(direction, velocity)
    for k in range(len(direction)):
        implicit = mechanics.motor_inertia[k] + step_s * mechanics.motor_viscous[k]
        push = mechanics.motor_inertia[k] * speed[k] + step_s * motor_torque[k]
        for i in range(total):
            p = direction[k, i]
            if p != 0.0:
                momentum[i] += p * push
                for j in range(total):
                    inertia[i, j] += p * implicit * direction[k, j]
    return inertia, momentum


@compiled
def _respond(
    lower: FloatArray, free_velocity: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A⁻¹ Dᵀ, shape (N, m), D v_free, shape (m,), and W, shape (m, m); A = L Lᵀ."""
    m, total = directions.shape
    response = np.empty((total, m))
    for k in range(m):
        column = directions[k].copy()
        _substitute(lower, column)
        for i in range(total):
            response[i, k] = column[i]
    return response, _times(directions, free_velocity), _product(directions, response)


@compiled
def _factorise(matrix: FloatArray) -> None:
    """Cholesky factorisation in place, lower triangle;
    for these sizes faster than a library call.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(s) if i == j else s / matrix[j, j]


@compiled
def _substitute(lower: FloatArray, vector: FloatArray) -> None:
    """Solve A x = vector in place, A = L Lᵀ."""
    size = len(vector)
    for i in range(size):
        s = vector[i]
        for k in range(i):
            s -= lower[i, k] * vector[k]
        vector[i] = s / lower[i, i]
    for i in range(size - 1, -1, -1):
        s = vector[i]
        for k in range(i + 1, size):
            s -= lower[k, i] * vector[k]
        vector[i] = s / lower[i, i]


@compiled
def _resting(
    impulse: FloatArray, bound: FloatArray, directions: FloatArray, lone: IntArray
) -> BoolArray:
    """Return the coordinates held at rest by sticking directions, shape (N,)."""
    resting = np.zeros(directions.shape[1], dtype=np.bool_)
    for k in range(len(impulse)):
        if lone[k] >= 0 and abs(impulse[k]) < bound[k]:
            resting[lone[k]] = True
    for k in range(len(impulse)):
        if lone[k] < 0 and abs(impulse[k]) < bound[k]:
            # It holds its last moving coordinate: a coupled motor's brake while the other joint
            # rests.
            free = 0
            last = 0
            for i in range(directions.shape[1]):
                if directions[k, i] != 0.0 and not resting[i]:
                    free += 1
                    last = i
            if free == 1:
                resting[last] = True
    return resting


@compiled
def solve(
    delassus: FloatArray,
    free: FloatArray,
    bound: FloatArray,
    impulse: FloatArray,
    tolerance: float,
    sweeps: int,
    dependent: float,
) -> float:
    """Solve for the impulses in place, starting from those of the step before.

    Gauss-Seidel sweeps find which directions stick; where they converge slowly (ill-conditioned
    inertias), the sticking ones are solved for directly, stopping at the first bound. Both only
    lower the convex cost, so together they end.

    Args:
        delassus: W, shape (m, m), symmetric, positive on the diagonal.
        free: speeds without dry friction [rad/s], shape (m,).
        bound: largest impulse of each direction [Nm s], shape (m,), not negative.
        impulse: λ, start value in and solution out, shape (m,).
        tolerance: largest accepted certificate [rad/s].
        sweeps: largest number of Gauss-Seidel sweeps.
        dependent: relative pivot below which a sticking direction depends on those before it.

    Returns:
        the certificate: the largest |λ_k − clip(λ_k − w_k/W_kk, −b_k, b_k)| W_kk [rad/s],
        recomputed after the last sweep. It is zero exactly at the solution; a direction inside its
        bound has |w_k| at most this.
    """
    for k in range(len(free)):
        if not np.isfinite(free[k]):
            return np.inf  # a comparison with NaN would pass for a solution
        impulse[k] = min(max(impulse[k], -bound[k]), bound[k])
    residual = np.inf
    for sweep in range(sweeps):
        change = 0.0
        for k in range(len(free)):
            if bound[k] > 0.0:
                moved = _relaxed(delassus, free, bound, impulse, k)
                change = max(change, abs(moved - impulse[k]) * delassus[k, k])
                impulse[k] = moved
        if change <= tolerance:
            residual = 0.0
            for k in range(len(free)):
                moved = _relaxed(delassus, free, bound, impulse, k)
                residual = max(residual, abs(moved - impulse[k]) * delassus[k, k])
            if residual <= tolerance:
                break
        if sweep % SWEEPS_A_ROUND == SWEEPS_A_ROUND - 1:
            _stick(delassus, free, bound, impulse, dependent)
    return residual


@compiled
def _relaxed(
    delassus: FloatArray, free: FloatArray, bound: FloatArray, impulse: FloatArray, k: int
) -> float:
    """Return the impulse of direction k for given impulses of the others."""
    w = free[k]
    for j in range(len(free)):
        w += delassus[k, j] * impulse[j]
    return float(min(max(impulse[k] - w / delassus[k, k], -bound[k]), bound[k]))


@compiled
def _stick(
    delassus: FloatArray, free: FloatArray, bound: FloatArray, impulse: FloatArray, dependent: float
) -> None:
    """Bring the directions inside their bounds to rest by Cholesky,
    in as many pieces as bounds are met on the way.
    """
    m = len(free)
    lower = np.zeros((m, m))
    step = np.zeros(m)
    inside = np.zeros(m, dtype=np.bool_)
    for _ in range(m):
        # Factorise W over the free directions; a dependent one keeps its impulse, the others can
        # stop it as well.
        for i in range(m):
            inside[i] = abs(impulse[i]) < bound[i]
            step[i] = 0.0
            if not inside[i]:
                continue
            pivot = delassus[i, i]
            step[i] = -free[i]
            for j in range(m):
                step[i] -= delassus[i, j] * impulse[j]
            for j in range(i):
                if inside[j]:
                    s = delassus[i, j]
                    for k in range(j):
                        if inside[k]:
                            s -= lower[i, k] * lower[j, k]
                    lower[i, j] = s / lower[j, j]
                    pivot -= lower[i, j] ** 2
                    step[i] -= lower[i, j] * step[j]
            if pivot <= dependent * delassus[i, i]:
                inside[i] = False
                step[i] = 0.0
            else:
                lower[i, i] = np.sqrt(pivot)
                step[i] /= lower[i, i]
        if not _step_to_bound(lower, inside, bound, impulse, step):
            break


@compiled
def _step_to_bound(
    lower: FloatArray, inside: BoolArray, bound: FloatArray, impulse: FloatArray, step: FloatArray
) -> bool:
    """Finish the substitution, step as far as the bounds allow,
    and return whether a bound was met.
    """
    m = len(step)
    length = 1.0
    blocking = -1
    for i in range(m - 1, -1, -1):
        if inside[i]:
            for k in range(i + 1, m):
                if inside[k]:
                    step[i] -= lower[k, i] * step[k]
            step[i] /= lower[i, i]
            room = (bound[i] if step[i] > 0.0 else -bound[i]) - impulse[i]
            if abs(step[i]) * length > abs(room):
                length = room / step[i]
                blocking = i
    for i in range(m):
        if inside[i]:
            impulse[i] = min(max(impulse[i] + length * step[i], -bound[i]), bound[i])
    if blocking >= 0:
        if step[blocking] > 0.0:
            impulse[blocking] = bound[blocking]
        else:
            impulse[blocking] = -bound[blocking]
    return blocking >= 0
