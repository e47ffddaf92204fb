"""Joint torques as a linear function of the links' inertial parameters, for many samples at once.

Motions are screws (w, u): angular part, and linear part at the origin of the frame in which they
are written. Three kinds of them go from link to link by the same matrices, and therefore in one
product: the velocity V = (ω, v), the acceleration A = (α, a′) and the screw S_j of every joint j
that moves the link,

    V_i = X V + S q̇,        A_i = X A + S q̈ + V × S q̇,        S_j,i = X S_j,        X = Σ_f f(q) X_f,

with constant 6 × 6 matrices X_f and f of (1, cos q, sin q) for a revolute joint, (1, q) for a
prismatic one. Gravity is a base acceleration of −g. With a = a′ + ω × v, the acceleration of the
link frame's origin, Newton-Euler gives the wrench there,

    n = I α + ω × (I ω) + h × a,        f = m a + α × h + ω × (ω × h),        h = m c,

linear in (I, h, m): a 6 × 10 matrix Y. The torque of joint j is the power of the wrench over its
screw, S_jᵀ Y (paper eqs. 1-2, IDM_st without drive chain). Only what joint j moves is ever
computed; every operation is a plain product of arrays that are contiguous in time.
"""  # noqa: E501

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.model.robot import JointKind, Robot, skew

#: Samples computed at once: with fewer, most of the time goes into the calls of numpy
BLOCK_SAMPLES = 4096


def fill_rigid(
    robot: Robot,
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    out: FloatArray,
    wanted: BoolArray | None = None,
) -> None:
    """Write the columns of the rigid links into an array of the caller,
    who may use it again for the next piece.

    Args:
        robot: n joints.
        position, velocity, acceleration: of the joints [rad or m, and their derivatives], shape (n,
            k), time last.
        out: torque per unit of each parameter (LINK_PARAMETERS) [Nm or N], shape (n, n, 10, k):
            joint, link, parameter, sample; a view into a wider layout will do. Only links that the
            joint moves are written, so that the rest may be zeroed once and for all.
        wanted: parameters of each link that are written, shape (n, 10); all when None.
    """
    links = _links(robot)
    wanted = np.ones((len(links), 10), dtype=np.bool_) if wanted is None else wanted
    inertias, moments = ([_spans(own) for own in part] for part in (wanted[:, :6], wanted[:, 6:]))
    samples = position.shape[1]
    size = min(samples, BLOCK_SAMPLES)
    work = _work(robot, links, size)
    for first in range(0, samples, BLOCK_SAMPLES):
        block = slice(first, min(first + BLOCK_SAMPLES, samples))
        if block.stop - first != size:
            work = _work(robot, links, block.stop - first)
        for index, link in enumerate(links):
            _move(
                link,
                work,
                index,
                position[index, block],
                velocity[index, block],
                acceleration[index, block],
            )
            screws = work.screws[index]
            _fill_wrench(work.inertia, work.moments, screws[0], screws[1])
            for screw, mover in zip(screws[2:], link.movers, strict=True):
                row = out[mover, index, :, block]
                # Most joints turn or slide along an axis of their link's frame: their own row is
                # one of Y's.
                alone = link.component if mover == index else None
                for part in inertias[index]:
                    if alone is None:
                        np.einsum("dk,dck->ck", screw[:3], work.inertia[:, part], out=row[:6][part])
                    else:
                        row[:6][part] = work.inertia[alone, part] if alone < 3 else 0.0
                for part in moments[index]:
                    if alone is None:
                        np.einsum("dk,dck->ck", screw, work.moments[:, part], out=row[6:][part])
                    else:
                        row[6:][part] = work.moments[alone, part]


def _spans(wanted: BoolArray) -> list[slice]:
    """Stretches of what is wanted."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], wanted, [0])))).tolist()
    return [slice(first, last) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def rigid_torque(
    robot: Robot,
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    parameters: FloatArray,
) -> FloatArray:
    """Torque of the rigid links [Nm or N], shape (n, k):
    the columns of `fill_rigid` times ``parameters``, (n, 10).
    """
    links, out = _links(robot), np.empty_like(position)
    inertias = [_inertia(own) for own in parameters]
    for first in range(0, position.shape[1], BLOCK_SAMPLES):
        block = slice(first, first + BLOCK_SAMPLES)
        states = list(
            zip(position[:, block], velocity[:, block], acceleration[:, block], strict=True)
        )
        work = _work(robot, links, len(states[0][0]), movers=False)
        for index, link in enumerate(links):
            _move(link, work, index, *states[index])
        # The last one is what the base bears
        wrenches = np.zeros((len(links) + 1, 6, len(states[0][0])))
        for own, screws, inertia in zip(wrenches, work.screws, inertias, strict=False):
            v, (momentum, own[:]) = screws[0], inertia @ screws
            _add_cross(own[:3], v[:3], momentum[:3])
            _add_cross(own[:3], v[3:], momentum[3:])
            _add_cross(own[3:], v[:3], momentum[3:])
        for index, link in reversed(list(enumerate(links))):
            out[index, block] = link.own @ wrenches[index]
            wrenches[link.parent] += _borne(link, wrenches[index], states[index][0])
    return out


def mass_matrix(robot: Robot, position: FloatArray, parameters: FloatArray) -> FloatArray:
    """Torque of the rigid links at joint i per unit of acceleration of joint j,
    Σ S_iᵀ M S_j over the links, (n, n, k).

    Args:
        robot: n joints.
        position: of the joints, shape (n, k).
        parameters: of the links (LINK_PARAMETERS), shape (n, 10).
    """
    links, (count, samples) = _links(robot), position.shape
    inertias, out = [_inertia(own) for own in parameters], np.zeros((count, count, samples))
    for first in range(0, samples, BLOCK_SAMPLES):
        here = position[:, first : first + BLOCK_SAMPLES]
        work, still = _work(robot, links, here.shape[1]), np.zeros(here.shape[1])
        for index, (link, inertia) in enumerate(zip(links, inertias, strict=True)):
            _move(link, work, index, here[index], still, still)
            screws = work.screws[index][2:]
            part = out[:, :, first : first + BLOCK_SAMPLES]
            part[np.ix_(link.movers, link.movers)] += np.einsum(
                "idk,jdk->ijk", screws, inertia @ screws
            )
    return out


def _add_cross(out: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Add the cross products of vectors of shape (3, k)."""
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[i] += a[j] * b[k] - a[k] * b[j]


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine to the last digit of one, by the half-angle:
    numpy has a vector tangent, four times as fast.
    """
    tangent = np.tan(0.5 * angle)
    square = tangent * tangent
    share = 1.0 / (1.0 + square)
    return (1.0 - square) * share, 2.0 * tangent * share


def _inertia(parameters: FloatArray) -> FloatArray:
    """Momentum of a link per unit of its screw, from its ten parameters (LINK_PARAMETERS),
    shape (6, 6).
    """
    first, mass = skew(parameters[6:9]), parameters[9] * np.eye(3)
    return np.block(
        [[parameters[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3), first], [-first, mass]]
    )


@dataclass(frozen=True, slots=True)
class _Link:
    """Constants of a link.

    Its joint turns or slides along z of a frame of its own: there cos q and sin q, or q, touch two
    components in three, and most robots' links have that frame already.
    """

    parent: int
    movers: tuple[int, ...]
    revolute: bool
    fixed: FloatArray  #: from the parent's frame to the joint's at q = 0, shape (6, 6)
    back: FloatArray | None  #: from the joint's frame to the link's; None where they are the same
    own: FloatArray  #: S in the link's frame, shape (6,)
    #: the only one that S has, where it is 1; None where S is no axis of the frame
    component: int | None


@dataclass(frozen=True, slots=True)
class _Work:
    """Arrays that every block uses again: V, A and the movers' screws of each link,
    shape (2 + movers, 6, k) (the base is the last), room for products, and Y.
    """

    screws: tuple[FloatArray, ...]
    products: FloatArray
    inertia: FloatArray
    moments: FloatArray


def _links(robot: Robot) -> tuple[_Link, ...]:
    links: list[_Link] = []
    for index, joint in enumerate(robot.joints):
        revolute, axis = joint.kind is JointKind.REVOLUTE, joint.axis
        first = np.eye(3)[np.argmin(np.abs(axis))]
        first = (first - axis * (axis @ first)) / np.sqrt(1.0 - (axis @ first) ** 2)
        turn = np.array((first, skew(axis) @ first, axis))
        own = np.zeros(6)
        own[slice(0, 3) if revolute else slice(3, 6)] = axis
        links.append(
            _Link(
                parent=joint.parent,
                movers=(*(links[joint.parent].movers if joint.parent >= 0 else ()), index),
                revolute=revolute,
                fixed=_blocks(
                    turn @ joint.rotation.T, -turn @ joint.rotation.T @ skew(joint.translation_m)
                ),
                back=None if (turn == np.eye(3)).all() else _blocks(turn.T),
                own=own,
                component=int(np.argmax(own))
                if np.count_nonzero(own) == 1 and own.max() == 1.0
                else None,
            )
        )
    return tuple(links)


def _work(robot: Robot, links: tuple[_Link, ...], samples: int, *, movers: bool = True) -> _Work:
    base = np.zeros((2, 6, samples))
    base[1, 3:] = -robot.gravity_m_s2[:, None]
    screws = [np.empty((2 + movers * len(link.movers), 6, samples)) for link in links]
    for link, array in zip(links, screws, strict=True):
        array[2:] = link.own[:, None]  # the last one stays
    products = np.empty((1 + robot.joint_count, 2, 2, samples))
    return _Work((*screws, base), products, np.zeros((3, 6, samples)), np.zeros((6, 4, samples)))


def _move(
    link: _Link,
    work: _Work,
    index: int,
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> None:
    """Carry the parent's screws to a link, through the frame of its joint."""
    before = work.screws[link.parent]
    here = work.screws[index][: len(before)]
    np.matmul(link.fixed, before, out=here)
    parts = here.reshape(len(here), 2, 3, -1)  # angular and linear
    v, a = parts[:2]
    # S × S is nothing: V may be that before S q̇ is added.
    if link.revolute:
        cosine, sine = cos_sin(position)
        turned = np.multiply(parts[:, :, 1::-1], sine, out=work.products[: len(here)])
        parts[:, :, :2] *= cosine
        parts[:, :, 0] += turned[:, :, 0]
        parts[:, :, 1] -= turned[:, :, 1]
        a[:, 0] += v[:, 1] * velocity
        a[:, 1] -= v[:, 0] * velocity
    else:
        parts[:, 1, 0] += position * parts[:, 0, 1]
        parts[:, 1, 1] -= position * parts[:, 0, 0]
        a[1, 0] += v[0, 1] * velocity
        a[1, 1] -= v[0, 0] * velocity
    kind = 0 if link.revolute else 1
    v[kind, 2] += velocity
    a[kind, 2] += acceleration
    if link.back is not None:
        here[:] = link.back @ here


def _borne(link: _Link, wrench: FloatArray, position: FloatArray) -> FloatArray:
    """A link's wrench at its parent, shape (6, k): the transpose of `_move`."""
    n, f = (wrench if link.back is None else link.back.T @ wrench).reshape(2, 3, -1)
    if link.revolute:
        c, s = cos_sin(position)
        n, f = (np.stack((c * x - s * y, s * x + c * y, z)) for x, y, z in (n, f))
    else:
        n = np.stack((n[0] - position * f[1], n[1] + position * f[0], n[2]))
    return link.fixed.T @ np.concatenate((n, f))


def _blocks(diagonal: FloatArray, lower: FloatArray | None = None) -> FloatArray:
    """[[D, 0], [L, D]]: how screws (w, u) change frames."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = diagonal
    if lower is not None:
        out[3:, :3] = lower
    return out


def _fill_wrench(
    inertia: FloatArray, moments: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> None:
    """Y, in two parts: the moment of unit inertias, shape (3, 6, k);
    moment and force of unit (h, m), shape (6, 4, k).

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
