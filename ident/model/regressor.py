"""Joint torques as a linear function of the links' inertial parameters, for many samples at once.

Motions are screws (w, u): angular part, and linear part at the origin of the frame in which they
are written. Three kinds of them go from link to link by the same matrices, and therefore in one
product: the velocity V = (ω, v), the acceleration A = (α, a′) and the screw S_j of every joint j
that moves the link,

    V_i = X V + S q̇,    A_i = X A + S q̈ + V × S q̇,    S_j,i = X S_j,    X = Σ_f f(q) X_f,

with constant 6 × 6 matrices X_f and f of (1, cos q, sin q) for a revolute joint, (1, q) for a
prismatic one. Gravity is a base acceleration of −g. With a = a′ + ω × v, the acceleration of the
link frame's origin, Newton-Euler gives the wrench there,

    n = I α + ω × (I ω) + h × a,        f = m a + α × h + ω × (ω × h),        h = m c,

linear in (I, h, m): a 6 × 10 matrix Y. The torque of joint j is the power of the wrench over its
screw, S_jᵀ Y (paper eqs. 1-2, IDM_st without drive chain). Only what joint j moves is ever
computed; every operation is a plain product of arrays that are contiguous in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, true_stretches
from ident.model.robot import Joint, JointKind, Robot, skew

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
            joint moves are written, so the rest may be zeroed once.
        wanted: parameters of each link that are written, shape (n, 10); all when None.
    """
    links = _links(robot)
    if wanted is None:
        wanted = np.ones((len(links), 10), dtype=np.bool_)
    inertias = [_spans(own) for own in wanted[:, :6]]
    moments = [_spans(own) for own in wanted[:, 6:]]
    samples = position.shape[1]
    size = min(samples, BLOCK_SAMPLES)
    work = _work(robot, links, size)
    for first in range(0, samples, BLOCK_SAMPLES):
        end = min(first + BLOCK_SAMPLES, samples)
        block = slice(first, end)
        if end - first != size:
            work = _work(robot, links, end - first)
        for index, link in enumerate(links):
            place = _placed(link, position[index, block])
            _move(link, work, index, place, velocity[index, block], acceleration[index, block])
            screws = work.screws[index]
            _fill_wrench(work.inertia, work.moments, screws[0], screws[1])
            for screw, mover in zip(screws[2:], link.movers, strict=True):
                row = out[mover, index, :, block]
                # Most joints turn or slide along an axis of their link's frame: their own row is
                # one of Y's.
                if mover == index and link.component is not None:
                    _copy_row(work, link.component, row, inertias[index], moments[index])
                else:
                    _project_row(work, screw, row, inertias[index], moments[index])


def _copy_row(
    work: _Work,
    component: int,
    row: FloatArray,
    inertias: Sequence[slice],
    moments: Sequence[slice],
) -> None:
    """Write one row of Y, of a joint whose screw is a unit vector, into spans of parameters."""
    of_inertia = row[:6]
    of_moments = row[6:]
    is_angular = component < 3
    for span in inertias:
        if is_angular:
            of_inertia[span] = work.inertia[component, span]
        else:
            of_inertia[span] = 0.0
    for span in moments:
        of_moments[span] = work.moments[component, span]


def _project_row(
    work: _Work,
    screw: FloatArray,
    row: FloatArray,
    inertias: Sequence[slice],
    moments: Sequence[slice],
) -> None:
    """Write SᵀY of a joint into spans of parameters: Σ_d S_dk Y_dck of parameter c, sample k."""
    of_inertia = row[:6]
    of_moments = row[6:]
    angular = screw[:3]
    for span in inertias:
        inertia = work.inertia[:, span]
        np.einsum("dk,dck->ck", angular, inertia, out=of_inertia[span])
    for span in moments:
        moment = work.moments[:, span]
        np.einsum("dk,dck->ck", screw, moment, out=of_moments[span])


def _spans(wanted: BoolArray) -> list[slice]:
    """Spans of indices that are wanted."""
    return [slice(*span) for span in true_stretches(wanted)]


def rigid_torque(
    robot: Robot,
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    parameters: FloatArray,
) -> FloatArray:
    """Torque of rigid links [Nm or N], (n, k): `fill_rigid` times ``parameters``, (n, 10)."""
    links = _links(robot)
    inertias = [_inertia(own) for own in parameters]
    out = np.empty_like(position)
    size = min(position.shape[1], BLOCK_SAMPLES)
    work = _work(robot, links, size, movers=False)
    wrenches = np.zeros((len(links) + 1, 6, size))  # the last one is what the base bears
    for first in range(0, position.shape[1], BLOCK_SAMPLES):
        block = slice(first, first + BLOCK_SAMPLES)
        q = position[:, block]
        dq = velocity[:, block]
        ddq = acceleration[:, block]
        samples = q.shape[1]
        if samples != size:
            work = _work(robot, links, samples, movers=False)
            wrenches = np.zeros((len(links) + 1, 6, samples))
        # Each cosine serves the way out and the way back.
        places = [_placed(link, own) for link, own in zip(links, q, strict=True)]
        for index, link in enumerate(links):
            _move(link, work, index, places[index], dq[index], ddq[index])
        for index, inertia in enumerate(inertias):
            _fill_inertial_wrench(wrenches[index], work.screws[index], inertia)
        for index in reversed(range(len(links))):
            link = links[index]
            out[index, block] = link.own @ wrenches[index]
            wrenches[link.parent] += _borne(link, wrenches[index], places[index])
    return out


def _fill_inertial_wrench(wrench: FloatArray, screws: FloatArray, inertia: FloatArray) -> None:
    """Write M A + V ×* M V of a link, moment first, shape (6, k).

    Args:
        wrench: to write into.
        screws: V and A, shape (2, 6, k).
        inertia: M, shape (6, 6).
    """
    angular = screws[0, :3]
    linear = screws[0, 3:]
    momentum, wrench[:] = inertia @ screws
    moment = wrench[:3]
    force = wrench[3:]
    _add_cross(moment, angular, momentum[:3])
    _add_cross(moment, linear, momentum[3:])
    _add_cross(force, angular, momentum[3:])


def mass_matrix(robot: Robot, position: FloatArray, parameters: FloatArray) -> FloatArray:
    """Torque at joint i per unit of acceleration of joint j, Σ S_iᵀ M S_j, shape (n, n, k).

    Args:
        robot: n joints.
        position: of the joints, shape (n, k).
        parameters: of the links (LINK_PARAMETERS), shape (n, 10).
    """
    links = _links(robot)
    inertias = [_inertia(own) for own in parameters]
    count, samples = position.shape
    out = np.zeros((count, count, samples))
    for first in range(0, samples, BLOCK_SAMPLES):
        block = slice(first, first + BLOCK_SAMPLES)
        q = position[:, block]
        of_block = out[:, :, block]
        work = _work(robot, links, q.shape[1])
        still = np.zeros(q.shape[1])
        for index, (link, inertia) in enumerate(zip(links, inertias, strict=True)):
            _move(link, work, index, _placed(link, q[index]), still, still)
            screws = work.screws[index][2:]
            momenta = inertia @ screws
            # S_iᵀ M S_j of the joints i and j that move this link
            of_link = np.einsum("idk,jdk->ijk", screws, momenta)
            movers = np.ix_(link.movers, link.movers)
            of_block[movers] += of_link
    return out


def _add_cross(out: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Add the cross products of vectors of shape (3, k)."""
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[i] += a[j] * b[k] - a[k] * b[j]


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of angles of any shape to the last digit of one, by the half-angle.

    numpy has a vector tangent, four times as fast.
    """
    tangent = np.tan(0.5 * angle)
    square = tangent * tangent
    share = 1.0 / (1.0 + square)
    cosine = (1.0 - square) * share
    sine = 2.0 * tangent * share
    return cosine, sine


#: Which of LINK_PARAMETERS each entry of the inertia tensor is
_OF_TENSOR = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _inertia(parameters: FloatArray) -> FloatArray:
    """Momentum of a link per unit of its screw, from its LINK_PARAMETERS, shape (6, 6)."""
    tensor = parameters[_OF_TENSOR]
    first_moment = skew(parameters[6:9])
    mass = parameters[9] * np.eye(3)
    return np.block([[tensor, first_moment], [-first_moment, mass]])


@dataclass(frozen=True, slots=True)
class _Link:
    """Constants of a link.

    Its joint turns or slides along z of the joint's frame: there cos q and sin q, or q, touch two
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
    """Arrays that every block uses again."""

    #: V, A and the movers' screws of each link, shape (2 + movers, 6, k); the base is the last
    screws: tuple[FloatArray, ...]
    products: FloatArray  #: room for products
    inertia: FloatArray
    moments: FloatArray


@dataclass(frozen=True, slots=True)
class _JointPlace:
    """Where a joint is, over k samples."""

    position: FloatArray  #: shape (k,)
    cosine: FloatArray  #: of the angle of a revolute joint; empty of a prismatic one
    sine: FloatArray  #: the same of its sine


def _placed(link: _Link, position: FloatArray) -> _JointPlace:
    """Place of a link's joint, with what turns its frame."""
    if not link.revolute:
        none = np.empty(0)
        return _JointPlace(position, none, none)
    cosine, sine = cos_sin(position)
    return _JointPlace(position, cosine, sine)


def _links(robot: Robot) -> tuple[_Link, ...]:
    """Constants of all links."""
    links: list[_Link] = []
    for index, joint in enumerate(robot.joints):
        before: tuple[int, ...] = ()
        if joint.parent >= 0:
            before = links[joint.parent].movers
        links.append(_link(joint, (*before, index)))
    return tuple(links)


def _link(joint: Joint, movers: tuple[int, ...]) -> _Link:
    """Constants of the link behind a joint."""
    axis = joint.axis
    revolute = joint.kind is JointKind.REVOLUTE
    turn = _frame_about(axis)
    own = np.zeros(6)
    if revolute:
        own[:3] = axis
    else:
        own[3:] = axis
    back = None
    if not np.array_equal(turn, np.eye(3)):
        back = _blocks(turn.T)
    component = None
    if np.count_nonzero(own) == 1 and own.max() == 1.0:
        component = int(np.argmax(own))
    rotation = turn @ joint.rotation.T
    lower = -turn @ joint.rotation.T @ skew(joint.translation_m)
    return _Link(
        parent=joint.parent,
        movers=movers,
        revolute=revolute,
        fixed=_blocks(rotation, lower),
        back=back,
        own=own,
        component=component,
    )


def _frame_about(axis: FloatArray) -> FloatArray:
    """Rotation to a frame whose z is an axis, x near the one most across to it, shape (3, 3)."""
    most_across = np.argmin(np.abs(axis))
    across = np.eye(3)[most_across]
    cosine = axis @ across
    sine = np.sqrt(1.0 - cosine**2)
    x = (across - axis * cosine) / sine
    y = skew(axis) @ x
    return np.array((x, y, axis))


def _work(robot: Robot, links: tuple[_Link, ...], samples: int, *, movers: bool = True) -> _Work:
    """Arrays for so many samples; without movers, room for V and A alone."""
    base = np.zeros((2, 6, samples))
    base[1, 3:] = -robot.gravity_m_s2[:, None]
    screws: list[FloatArray] = []
    for link in links:
        count = 2
        if movers:
            count += len(link.movers)
        of_link = np.empty((count, 6, samples))
        of_link[2:] = link.own[:, None]  # the last one stays
        screws.append(of_link)
    products = np.empty((1 + robot.joint_count, 2, 2, samples))
    inertia = np.zeros((3, 6, samples))
    moments = np.zeros((6, 4, samples))
    return _Work((*screws, base), products, inertia, moments)


def _move(
    link: _Link,
    work: _Work,
    index: int,
    place: _JointPlace,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> None:
    """Carry the parent's screws to a link, through the frame of its joint."""
    before = work.screws[link.parent]
    count = len(before)
    here = work.screws[index][:count]
    np.matmul(link.fixed, before, out=here)
    parts = here.reshape(count, 2, 3, -1)  # angular and linear
    v = parts[0]
    a = parts[1]
    # S × S is nothing: V may be that before S q̇ is added.
    if link.revolute:
        turned = np.multiply(parts[:, :, 1::-1], place.sine, out=work.products[:count])
        parts[:, :, :2] *= place.cosine
        parts[:, :, 0] += turned[:, :, 0]
        parts[:, :, 1] -= turned[:, :, 1]
        a[:, 0] += v[:, 1] * velocity
        a[:, 1] -= v[:, 0] * velocity
    else:
        parts[:, 1, 0] += place.position * parts[:, 0, 1]
        parts[:, 1, 1] -= place.position * parts[:, 0, 0]
        a[1, 0] += v[0, 1] * velocity
        a[1, 1] -= v[0, 0] * velocity
    kind = 1
    if link.revolute:
        kind = 0
    v[kind, 2] += velocity
    a[kind, 2] += acceleration
    if link.back is not None:
        here[:] = link.back @ here


def _borne(link: _Link, wrench: FloatArray, place: _JointPlace) -> FloatArray:
    """A link's wrench at its parent, shape (6, k): the transpose of `_move`."""
    if link.back is not None:
        wrench = link.back.T @ wrench
    at_joint = wrench.copy()
    if link.revolute:
        moment_and_force = wrench.reshape(2, 3, -1)
        x, y, _ = np.moveaxis(moment_and_force, 1, 0)
        turned = at_joint.reshape(2, 3, -1)
        turned[:, 0] = place.cosine * x - place.sine * y
        turned[:, 1] = place.sine * x + place.cosine * y
    else:
        force = wrench[3:]
        at_joint[0] -= place.position * force[1]
        at_joint[1] += place.position * force[0]
    return np.asarray(link.fixed.T @ at_joint)


def _blocks(diagonal: FloatArray, lower: FloatArray | None = None) -> FloatArray:
    """[[D, 0], [L, D]]: how screws (w, u) change frames."""
    out = np.zeros((6, 6))
    out[:3, :3] = diagonal
    out[3:, 3:] = diagonal
    if lower is not None:
        out[3:, :3] = lower
    return out


def _fill_wrench(
    inertia: FloatArray, moments: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> None:
    """Y: the moment of unit inertias, (3, 6, k); moment and force of unit (h, m), (6, 4, k).

    What is zero in every motion is left as it is.
    """
    w = velocity[:3]
    x, y, z = w
    squares = w * w
    mixed = (x * y, x * z, y * z)
    _fill_inertia_columns(inertia, acceleration[:3], squares, mixed)
    _fill_moment_columns(moments, velocity, acceleration, squares, mixed)


def _fill_inertia_columns(
    inertia: FloatArray,
    dw: FloatArray,
    squares: FloatArray,
    mixed: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Columns of K(α) + [ω] K(ω), where I x = K(x) (Ixx, Ixy, Ixz, Iyy, Iyz, Izz).

    Args:
        inertia: to write into, shape (3, 6, k).
        dw: α, shape (3, k).
        squares: ω_x², ω_y², ω_z².
        mixed: ω_x ω_y, ω_x ω_z, ω_y ω_z.
    """
    xx, yy, zz = squares
    xy, xz, yz = mixed
    inertia[0, 0] = dw[0]
    inertia[1, 1] = dw[0]
    inertia[2, 2] = dw[0]
    inertia[0, 1] = dw[1]
    inertia[1, 3] = dw[1]
    inertia[2, 4] = dw[1]
    inertia[0, 2] = dw[2]
    inertia[1, 4] = dw[2]
    inertia[2, 5] = dw[2]
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


def _fill_moment_columns(
    moments: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    squares: FloatArray,
    mixed: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Force m a + ([α] + [ω]²) h and moment −[a] h of unit (h, m).

    Args:
        moments: to write into, shape (6, 4, k).
        velocity, acceleration: V and A, shape (6, k).
        squares, mixed: of ω, as for `_fill_inertia_columns`.
    """
    wx, wy, wz, vx, vy, vz = velocity
    dw = acceleration[:3]
    dv = acceleration[3:]
    xx, yy, zz = squares
    xy, xz, yz = mixed
    # a = v̇ + ω × v
    a = moments[3:, 3]
    np.add(dv[0], wy * vz - wz * vy, out=a[0])
    np.add(dv[1], wz * vx - wx * vz, out=a[1])
    np.add(dv[2], wx * vy - wy * vx, out=a[2])
    moments[0, 1] = a[2]
    moments[1, 2] = a[0]
    moments[2, 0] = a[1]
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
