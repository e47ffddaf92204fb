"""Joint torques as a linear function of the links' inertial parameters, for many samples at once.

For link i with angular velocity ω, angular acceleration α and linear acceleration a of its frame's origin (gravity
taken as a base acceleration of −g), all in its own frame, Newton-Euler gives the wrench at that origin

    f = m a + α × h + ω × (ω × h),        n = I α + ω × (I ω) + h × a,        h = m c.

A joint j below it moves the link with a screw: w (angular) and u (linear, at the link frame's origin). The joint's
torque is the power of the wrench over that screw, u·f + w·n, which is linear in (I, h, m):

    ∂/∂m = u·a,     ∂/∂h = u × α + (u·ω) ω − |ω|² u + a × w,     ∂/∂I from w·Iα + (w × ω)·Iω.

So no 6 × 10 matrix is moved from link to link, only screws; every operation is a plain product of arrays that are
contiguous in time (paper eqs. 1-2, IDM_st without drive chain).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.robot import JointKind, Robot

FloatArray = NDArray[np.float64]


def rigid_regressor(robot: Robot, position: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Columns of the rigid links.

    Args:
        robot: n joints.
        position, velocity, acceleration: of the joints [rad or m, and their derivatives], shape (n, k), time last.

    Returns:
        shape (n, 10 n, k): row of joint j, column 10 i + p of parameter p (LINK_PARAMETERS) of link i, sample
        [Nm or N per unit].
    """
    count = robot.joint_count
    samples = position.shape[1]
    columns = np.zeros((count, 10 * count, samples))
    omega: list[FloatArray] = []
    alpha: list[FloatArray] = []
    linear: list[FloatArray] = []
    screws: list[dict[int, tuple[FloatArray, FloatArray]]] = []
    base = np.repeat(-robot.gravity_m_s2[:, None], samples, axis=1)
    still = np.zeros((3, samples))
    for index, joint in enumerate(robot.joints):
        parent = joint.parent
        before = (omega[parent], alpha[parent], linear[parent]) if parent >= 0 else (still, still, base)
        revolute = joint.kind is JointKind.REVOLUTE
        axis = joint.axis[:, None]
        offset = joint.translation_m[:, None]
        if not revolute:
            offset = offset + (joint.rotation @ axis) * position[index]
        # The joint's origin, seen from the parent: a_o = a + α × p + ω × (ω × p).
        origin = before[2] + _cross(before[1], offset) + _cross(before[0], _cross(before[0], offset))
        into = _into_link(joint.rotation, joint.axis, position[index] if revolute else None, samples)
        w, dw, a = (_apply(into, vector) for vector in (before[0], before[1], origin))
        if revolute:
            dw = dw + axis * acceleration[index] + _cross(w, axis * velocity[index])
            w = w + axis * velocity[index]
        else:
            a = a + axis * acceleration[index] + 2.0 * _cross(w, axis * velocity[index])
        omega.append(w)
        alpha.append(dw)
        linear.append(a)
        moved = {}
        if parent >= 0:
            # A screw's linear part is taken at this link's origin: u' = u + w × p.
            for ancestor, (angular, along) in screws[parent].items():
                moved[ancestor] = (_apply(into, angular), _apply(into, along + _cross(angular, offset)))
        own = np.repeat(axis, samples, axis=1)
        moved[index] = (own, still) if revolute else (still, own)
        screws.append(moved)
        for row, (angular, along) in moved.items():
            _fill(columns[row, 10 * index : 10 * index + 10], angular, along, w, dw, a)
    return columns


def _into_link(rotation: FloatArray, axis: FloatArray, angle: FloatArray | None, samples: int) -> FloatArray:
    """Rotation matrices from the parent's frame into the link's, shape (3, 3, k)."""
    if angle is None:
        return np.repeat(rotation.T[:, :, None], samples, axis=2)
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    outer = np.outer(axis, axis)
    # (R exp(skew θ))ᵀ = exp(−skew θ) Rᵀ, by Rodrigues' formula.
    fixed, cosine, sine = outer @ rotation.T, (np.eye(3) - outer) @ rotation.T, -skew @ rotation.T
    return fixed[:, :, None] + cosine[:, :, None] * np.cos(angle) + sine[:, :, None] * np.sin(angle)


def _apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return np.asarray(matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _fill(out: FloatArray, w: FloatArray, u: FloatArray, omega: FloatArray, alpha: FloatArray, a: FloatArray) -> None:
    p = _cross(w, omega)
    row = 0
    for i in range(3):
        for j in range(i, 3):
            out[row] = w[i] * alpha[j] + p[i] * omega[j]
            if i != j:
                out[row] += w[j] * alpha[i] + p[j] * omega[i]
            row += 1
    out[6:9] = _cross(u, alpha) + _dot(u, omega) * omega - _dot(omega, omega) * u + _cross(a, w)
    out[9] = _dot(u, a)
