"""One step of the equations of motion: speeds without dry friction, its response matrix, and the final update.

With M the inertia of the links, P the motors' directions (τ = Pᵀ τ_m, Ia and motor friction act along its rows) and
h the step:

    A = M + Pᵀ diag(Ia + h Fv_m) P + h diag(Fv),     A v_free = (M + Pᵀ diag(Ia) P) v + h (Pᵀ τ_m + τ − c(q, q̇)),

that is semi-implicit Euler with implicit viscous friction. Dry friction adds A⁻¹ Dᵀ λ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.simulation.friction import compiled

FloatArray = NDArray[np.float64]


@compiled
def free_motion(
    mass: FloatArray,
    bias: FloatArray,
    motor_direction: FloatArray,
    motor_inertia: FloatArray,
    motor_viscous: FloatArray,
    viscous: FloatArray,
    motor_torque: FloatArray,
    torque: FloatArray,
    velocity: FloatArray,
    directions: FloatArray,
    step_s: float,
    free_velocity: FloatArray,
    response: FloatArray,
    free_speed: FloatArray,
    delassus: FloatArray,
) -> None:
    """Compute the motion without dry friction and write it to the last four arguments.

    Args:
        mass, bias: links, shapes (n, n) and (n,); coordinates after the n-th (motors of flexible drives) have no link.
        motor_direction: P, shape (motors, N).
        motor_inertia, motor_viscous, motor_torque: along the rows of P, shape (motors,).
        viscous: on each coordinate, shape (N,).
        torque: on each coordinate, shape (N,).
        velocity: at the start of the step, shape (N,).
        directions: D of dry friction, shape (m, N).
        step_s: h.
        free_velocity: v_free, shape (N,).
        response: A⁻¹ Dᵀ, shape (N, m).
        free_speed: D v_free, shape (m,).
        delassus: D A⁻¹ Dᵀ, shape (m, m).
    """
    total = len(velocity)
    m = len(directions)
    inertia = np.zeros((total, total))
    momentum = np.zeros(total)
    for i in range(len(bias)):
        for j in range(len(bias)):
            inertia[i, j] = mass[i, j]
            momentum[i] += mass[i, j] * velocity[j]
        momentum[i] -= step_s * bias[i]
    for i in range(total):
        momentum[i] += step_s * torque[i]
        inertia[i, i] += step_s * viscous[i]
    _add_motors(motor_direction, motor_inertia, motor_viscous, motor_torque, velocity, step_s, inertia, momentum)
    _factorise(inertia)
    _substitute(inertia, momentum)
    column = np.empty(total)
    for i in range(total):
        free_velocity[i] = momentum[i]
    for k in range(m):
        column[:] = directions[k]
        _substitute(inertia, column)
        speed = 0.0
        for i in range(total):
            response[i, k] = column[i]
            speed += directions[k, i] * momentum[i]
        free_speed[k] = speed
    for k in range(m):
        for j in range(m):
            s = 0.0
            for i in range(total):
                s += directions[k, i] * response[i, j]
            delassus[k, j] = s


@compiled
def _add_motors(
    direction: FloatArray,
    motor_inertia: FloatArray,
    motor_viscous: FloatArray,
    motor_torque: FloatArray,
    velocity: FloatArray,
    step_s: float,
    inertia: FloatArray,
    momentum: FloatArray,
) -> None:
    total = len(velocity)
    for k in range(len(direction)):
        speed = 0.0
        for j in range(total):
            speed += direction[k, j] * velocity[j]
        implicit = motor_inertia[k] + step_s * motor_viscous[k]
        push = motor_inertia[k] * speed + step_s * motor_torque[k]
        for i in range(total):
            p = direction[k, i]
            if p != 0.0:
                momentum[i] += p * push
                for j in range(total):
                    inertia[i, j] += p * implicit * direction[k, j]


@compiled
def _factorise(matrix: FloatArray) -> None:
    """Cholesky factorisation in place, lower triangle; for these sizes faster than a library call."""
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
def finish_step(
    mass: FloatArray,
    bias: FloatArray,
    free_velocity: FloatArray,
    response: FloatArray,
    impulse: FloatArray,
    bound: FloatArray,
    directions: FloatArray,
    lone: NDArray[np.int64],
    step_s: float,
    motor: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    load_torque: FloatArray,
    motor_rad: FloatArray,
) -> None:
    """Apply the friction impulses and move (semi-implicit Euler).

    A direction whose friction is inside its bound sticks: the solver left it at most its tolerance of speed. Where that
    pins a coordinate, its speed becomes exactly zero here, so that a resting axis does not creep.

    Args:
        mass, bias: of the links at the start of the step.
        free_velocity, response: from free_motion.
        impulse, bound: of dry friction [Nm s], shape (m,).
        directions: of dry friction, shape (m, N).
        lone: coordinate of each direction that has only one, else -1, shape (m,).
        step_s: h.
        motor: rotor angles per coordinate, shape (n, N).
        position, velocity: state, changed in place, shape (N,).
        load_torque: torque of the links on each joint, M a + c(q, q̇) [Nm], shape (n,), output.
        motor_rad: rotor angles at the end of the step, shape (n,), output.
    """
    n = len(bias)
    total = len(velocity)
    change = np.empty(total)
    for i in range(total):
        v = free_velocity[i]
        for k in range(len(impulse)):
            v += response[i, k] * impulse[k]
        change[i] = v - velocity[i]
    resting = _resting(impulse, bound, directions, lone)
    for i in range(total):
        if resting[i]:
            # Written so that v + change is exactly zero.
            change[i] = -velocity[i]
    for i in range(n):
        s = bias[i]
        for j in range(n):
            s += mass[i, j] * change[j] / step_s
        load_torque[i] = s
    for i in range(total):
        velocity[i] += change[i]
        position[i] += step_s * velocity[i]
    for i in range(len(motor_rad)):
        s = 0.0
        for j in range(total):
            s += motor[i, j] * position[j]
        motor_rad[i] = s


@compiled
def _resting(
    impulse: FloatArray, bound: FloatArray, directions: FloatArray, lone: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return the coordinates held at rest by sticking directions, shape (N,)."""
    resting = np.zeros(directions.shape[1], dtype=np.bool_)
    for k in range(len(impulse)):
        if lone[k] >= 0 and abs(impulse[k]) < bound[k]:
            resting[lone[k]] = True
    for k in range(len(impulse)):
        if lone[k] < 0 and abs(impulse[k]) < bound[k]:
            _rest_with(directions[k], resting)
    return resting


@compiled
def _rest_with(direction: FloatArray, resting: NDArray[np.bool_]) -> None:
    """Hold the last moving coordinate of a sticking direction (a coupled motor's brake while the other joint rests)."""
    free = 0
    last = 0
    for i in range(len(direction)):
        if direction[i] != 0.0 and not resting[i]:
            free += 1
            last = i
    if free == 1:
        resting[last] = True
