"""Joint torques as a linear function of the links' inertial parameters, for many samples at once.

Motions are screws (w, u): angular part, and linear part at the origin of the frame in which they are written. Three
kinds of them go from link to link by the same matrices, and therefore in one product: the velocity V = (ω, v), the
acceleration A = (α, a′) and the screw S_j of every joint j that moves the link,

    V_i = X V + S q̇,        A_i = X A + S q̈ + V × S q̇,        S_j,i = X S_j,        X = Σ_f f(q) X_f,

with constant 6 × 6 matrices X_f and f of (1, cos q, sin q) for a revolute joint, (1, q) for a prismatic one. Gravity is
a base acceleration of −g. With a = a′ + ω × v, the acceleration of the link frame's origin, Newton-Euler gives the
wrench there,

    n = I α + ω × (I ω) + h × a,        f = m a + α × h + ω × (ω × h),        h = m c,

linear in (I, h, m): a 6 × 10 matrix Y. The torque of joint j is the power of the wrench over its screw, S_jᵀ Y (paper
eqs. 1-2, IDM_st without drive chain). Only what joint j moves is ever computed; every operation is a plain product of
arrays that are contiguous in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.model.robot import JointKind, Robot, skew

BLOCK_SAMPLES = 1024  #: Samples computed at once: their screws and products stay in a core's own cache


def fill_rigid(
    robot: Robot, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, out: FloatArray
) -> None:
    """Write the columns of the rigid links into an array of the caller, who may use it again for the next piece.

    Args:
        robot: n joints.
        position, velocity, acceleration: of the joints [rad or m, and their derivatives], shape (n, k), time last.
        out: torque per unit of each parameter (LINK_PARAMETERS) [Nm or N], shape (n, n, 10, k): joint, link,
            parameter, sample; a view into a wider layout will do. Only links that the joint moves are written, so that
            the rest may be zeroed once and for all.
    """
    links = _links(robot)
    samples = position.shape[1]
    size = min(samples, BLOCK_SAMPLES)
    work = _work(robot, links, size)
    for first in range(0, samples, BLOCK_SAMPLES):
        block = slice(first, min(first + BLOCK_SAMPLES, samples))
        if block.stop - first != size:
            work = _work(robot, links, block.stop - first)
        for index, link in enumerate(links):
            _move(link, work, index, position[index, block], velocity[index, block], acceleration[index, block])
            screws = work.screws[index]
            _fill_wrench(work.inertia, work.moments, screws[:, 0], screws[:, 1])
            for place, mover in enumerate(link.movers, start=2):
                screw, row = screws[:, place], out[mover, index, :, block]
                np.einsum("dk,dck->ck", screw[:3], work.inertia, out=row[:6])
                np.einsum("dk,dck->ck", screw, work.moments, out=row[6:])


def rigid_torque(
    robot: Robot, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, parameters: FloatArray
) -> FloatArray:
    """Torque of the rigid links [Nm or N], shape (n, k): the columns of `fill_rigid` times ``parameters``, (n, 10)."""
    links, out = _links(robot), np.empty_like(position)
    inertias = [_inertia(own) for own in parameters]
    for first in range(0, position.shape[1], BLOCK_SAMPLES):
        block = slice(first, first + BLOCK_SAMPLES)
        states = list(zip(position[:, block], velocity[:, block], acceleration[:, block], strict=True))
        work = _work(robot, links, len(states[0][0]), movers=False)
        factors = [_move(link, work, index, *states[index]) for index, link in enumerate(links)]
        wrenches = np.zeros((len(links) + 1, 6, len(states[0][0])))  # the last one is what the base bears
        for own, screws, inertia in zip(wrenches, work.screws, inertias, strict=False):
            v, (momentum, own[:]) = screws[:, 0], inertia @ np.swapaxes(screws, 0, 1)
            own[:3] += _cross(v[:3], momentum[:3]) + _cross(v[3:], momentum[3:])
            own[3:] += _cross(v[:3], momentum[3:])
        for link, own, given, row in reversed(list(zip(links, wrenches, factors, out, strict=False))):
            row[block] = link.own @ own
            wrenches[link.parent] += link.transforms.T @ np.concatenate((own, *(factor * own for factor in given)))
    return out


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross products of vectors of shape (3, k)."""
    return first[[1, 2, 0]] * second[[2, 0, 1]] - first[[2, 0, 1]] * second[[1, 2, 0]]


def _inertia(parameters: FloatArray) -> FloatArray:
    """Momentum of a link per unit of its screw, from its ten parameters (LINK_PARAMETERS), shape (6, 6)."""
    first, mass = skew(parameters[6:9]), parameters[9] * np.eye(3)
    return np.block([[parameters[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3), first], [-first, mass]])


@dataclass(frozen=True, slots=True)
class _Link:
    """Constants of a link: X_f below each other, shape (6 f, 6), S, and C with V × S = C V."""

    parent: int
    movers: tuple[int, ...]
    revolute: bool
    transforms: FloatArray
    own: FloatArray
    cross: FloatArray


@dataclass(frozen=True, slots=True)
class _Work:
    """Arrays that every block uses again: V, A and the movers' screws of each link (the base is the last), X_f times
    the parent's (flat, room for the longest), and Y."""

    screws: tuple[FloatArray, ...]
    products: FloatArray
    inertia: FloatArray
    moments: FloatArray


def _links(robot: Robot) -> tuple[_Link, ...]:
    links: list[_Link] = []
    for index, joint in enumerate(robot.joints):
        revolute = joint.kind is JointKind.REVOLUTE
        fixed, turned = _blocks(joint.rotation.T, -joint.rotation.T @ skew(joint.translation_m)), skew(joint.axis)
        if revolute:
            # exp(−skew θ) = e eᵀ + cos θ (1 − e eᵀ) − sin θ skew (Rodrigues).
            outer = np.outer(joint.axis, joint.axis)
            parts = [_blocks(turn) @ fixed for turn in (outer, np.eye(3) - outer, -turned)]
        else:
            # Slid along the axis e, u + w × (p + R e q): the second term is all that changes.
            parts = [fixed, _blocks(np.zeros((3, 3)), -turned @ joint.rotation.T)]
        own = np.zeros(6)
        own[slice(0, 3) if revolute else slice(3, 6)] = joint.axis
        links.append(
            _Link(
                parent=joint.parent,
                movers=(*(links[joint.parent].movers if joint.parent >= 0 else ()), index),
                revolute=revolute,
                transforms=np.concatenate(parts),
                own=own,
                cross=_blocks(-skew(own[:3]), -skew(own[3:])),
            )
        )
    return tuple(links)


def _work(robot: Robot, links: tuple[_Link, ...], samples: int, *, movers: bool = True) -> _Work:
    base = np.zeros((6, 2, samples))
    base[3:, 1] = -robot.gravity_m_s2[:, None]
    screws = [np.empty((6, 2 + movers * len(link.movers), samples)) for link in links]
    for link, array in zip(links, screws, strict=True):
        array[:, 2:] = link.own[:, None, None]  # the last one stays
    products = np.empty(18 * (1 + robot.joint_count) * samples)
    return _Work((*screws, base), products, np.zeros((3, 6, samples)), np.zeros((6, 4, samples)))


def _move(
    link: _Link, work: _Work, index: int, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> tuple[FloatArray, ...]:
    """Carry the parent's screws to a link; return the f(q) of its X_f, from the second one on."""
    before, here = work.screws[link.parent], work.screws[index]
    factors = (np.cos(position), np.sin(position)) if link.revolute else (position,)
    flat = before.reshape(6, -1)
    parts = work.products[: len(link.transforms) * flat.shape[1]].reshape(-1, *before.shape)
    np.matmul(link.transforms, flat, out=parts.reshape(-1, flat.shape[1]))
    carried = parts[0]
    for number, factor in enumerate(factors, start=1):
        parts[number] *= factor
        carried += parts[number]
    here[:, : before.shape[1]] = carried
    v, a = here[:, 0], here[:, 1]
    # S × S is nothing: V may be that before S q̇ is added.
    a += np.outer(link.own, acceleration) + (link.cross @ v) * velocity
    v += np.outer(link.own, velocity)
    return factors


def _blocks(diagonal: FloatArray, lower: FloatArray | None = None) -> FloatArray:
    """[[D, 0], [L, D]]: how screws (w, u) change frames."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = diagonal
    if lower is not None:
        out[3:, :3] = lower
    return out


def _fill_wrench(inertia: FloatArray, moments: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> None:
    """Y, in two parts: the moment of unit inertias, shape (3, 6, k); moment and force of unit (h, m), shape (6, 4, k).

    What is zero in every motion is left as it is.
    """
    w, v, dw = velocity[:3], velocity[3:], acceleration[:3]
    xx, yy, zz = w[0] * w[0], w[1] * w[1], w[2] * w[2]
    xy, xz, yz = w[0] * w[1], w[0] * w[2], w[1] * w[2]
    # Columns of K(α) + [ω] K(ω), where I x = K(x) (Ixx, Ixy, Ixz, Iyy, Iyz, Izz).
    inertia[0, 0] = inertia[1, 1] = inertia[2, 2] = dw[0]
    inertia[0, 1] = inertia[1, 3] = inertia[2, 4] = dw[1]
    inertia[0, 2] = inertia[1, 4] = inertia[2, 5] = dw[2]
    inertia[0, 1] -= xz
    inertia[0, 2] += xy
    inertia[1, 1] += yz
    inertia[1, 4] -= xy
    inertia[2, 2] -= yz
    inertia[2, 4] += xz
    inertia[0, 5] = yz
    inertia[1, 0] = xz
    inertia[2, 3] = xy
    np.negative(yz, out=inertia[0, 3])
    np.negative(xz, out=inertia[1, 5])
    np.negative(xy, out=inertia[2, 0])
    np.subtract(yy, zz, out=inertia[0, 4])
    np.subtract(zz, xx, out=inertia[1, 2])
    np.subtract(xx, yy, out=inertia[2, 1])
    # Force: m a + ([α] + [ω]²) h. Moment: −[a] h.
    origin = moments[3:, 3]
    np.add(acceleration[3], w[1] * v[2] - w[2] * v[1], out=origin[0])
    np.add(acceleration[4], w[2] * v[0] - w[0] * v[2], out=origin[1])
    np.add(acceleration[5], w[0] * v[1] - w[1] * v[0], out=origin[2])
    moments[0, 1], moments[1, 2], moments[2, 0] = origin[2], origin[0], origin[1]
    np.negative(moments[0, 1], out=moments[1, 0])
    np.negative(moments[1, 2], out=moments[2, 1])
    np.negative(moments[2, 0], out=moments[0, 2])
    np.negative(yy + zz, out=moments[3, 0])
    np.negative(xx + zz, out=moments[4, 1])
    np.negative(xx + yy, out=moments[5, 2])
    np.subtract(xy, dw[2], out=moments[3, 1])
    np.add(xz, dw[1], out=moments[3, 2])
    np.add(xy, dw[2], out=moments[4, 0])
    np.subtract(yz, dw[0], out=moments[4, 2])
    np.subtract(xz, dw[1], out=moments[5, 0])
    np.add(yz, dw[0], out=moments[5, 1])
