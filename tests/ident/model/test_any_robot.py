"""Any robot: the same questions to arms of six axes, one of seven and a gantry with a wrist."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.estimators.estimate import Estimate
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import DriveTrain, Model
from ident.model.robot import JointKind
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import CONFIGS
from tests.ident.recordings import positions

FloatArray = NDArray[np.float64]
Gravity = tuple[float, float, float]

UPRIGHT: Gravity = (0.0, 0.0, -9.81)
LEANING: Gravity = (5.6, -3.2, 7.4)
RATE_HZ = 250.0
SCREW = 2.0 * np.pi / 0.02
BELT = 5.0 * 2.0 * np.pi / 0.15


@dataclass(frozen=True)
class Kind:
    """A robot with a drive train that is not diagonal, and its gains.

    Attributes:
        urdf: file in configs/robots.
        ratio: R, shape (n, n).
        gains: at the joint [Nm/A or N/A], shape (n,).
        reach: half of each joint's range [rad or m], shape (n,).
    """

    urdf: str
    ratio: FloatArray
    gains: FloatArray
    reach: FloatArray


def _with(diagonal: list[float], entries: dict[tuple[int, int], float]) -> FloatArray:
    ratio = np.diag(diagonal)
    for place, value in entries.items():
        ratio[place] = value
    return ratio


KINDS = (
    # A coupled wrist, as the paper's: motor 6 also turns with joint 5.
    Kind(
        "tx40.urdf",
        _with([32, 32, 45, -48, 45, 32], {(5, 4): 32}),
        np.array([33.9, 32.4, 24.2, -9.21, 16.3, 6.79]),
        np.array([2.5, 1.8, 2.0, 3.0, 1.8, 3.0]),
    ),
    # A differential: motors 6 and 7 turn together with joint 6, against each other with joint 7.
    Kind(
        "seven-axis.urdf",
        _with([100, 100, 80, -80, 60, 50, -50], {(5, 6): 50, (6, 5): 50}),
        np.array([43.2, 39.6, 27.5, -24.8, 14.9, 7.75, -8.6]),
        np.array([2.5, 1.8, 2.5, 1.9, 2.5, 1.8, 2.9]),
    ),
    # One belt for X and Y, a screw for Z, and a wrist motor that turns with both of its joints.
    Kind(
        "gantry.urdf",
        _with([BELT, -BELT, SCREW, 80, 50], {(0, 1): BELT, (1, 0): BELT, (4, 3): -50}),
        np.array([109.3, -101.2, 149.8, 12.7, 6.6]),
        np.array([0.7, 0.45, 0.25, 3.0, 1.8]),
    ),
)
HEAVY = (
    Kind(
        "rx90.urdf",
        _with([128, 128, 101, -75, 75, 60], {(5, 4): 60}),
        np.array([44.1, 40.1, 33.6, -16.1, 18.2, 10.9]),
        np.array([2.5, 1.6, 2.2, 3.0, 1.8, 3.0]),
    ),
    # An in-line wrist: motor 5 also turns with joint 4, motor 6 with joints 4 and 5.
    Kind(
        "kr270.urdf",
        _with(
            [256.857, 267.429, 252.333, 221, 239.619, 154.323],
            {(4, 3): -59.905, (5, 3): 38.581, (5, 4): -51.441},
        ),
        np.array([353.2, 344.5, 320.4, 196.1, 195.3, 137.6]),
        np.array([2.0, 1.1, 2.2, 3.0, 2.0, 3.0]),
    ),
)
"""Beside these: in a chain of couplings a motor in another's place belongs to another joint,
so that other rows count; and a heavy arm that leans is refused, not only fitted badly.
"""
CASES = list(product((*KINDS, *HEAVY), (UPRIGHT, LEANING)))


def _name(value: object) -> str:
    if isinstance(value, Kind):
        return value.urdf.removesuffix(".urdf")
    return "upright" if value == UPRIGHT else "leaning"


@cache
def _truth(urdf: str, gravity: Gravity) -> tuple[Model, FloatArray, FloatArray]:
    """Model, standard parameters, and the inertial ones of a payload of 5 kg about the last joint's
    frame.
    """
    kind = next(kind for kind in (*KINDS, *HEAVY) if kind.urdf == urdf)
    text = (CONFIGS / "robots" / urdf).read_text()
    robot = robot_from_urdf(text, gravity)
    drive_train = DriveTrain(kind.ratio)
    model = Model(robot, drive_train)
    rng = np.random.default_rng(len(urdf))
    parameters = np.zeros(len(model.columns))
    for joint in range(model.robot.joint_count):
        first = 14 * joint
        mass = rng.uniform(1.0, 8.0)
        parameters[first : first + 10] = _body(rng, mass)
        parameters[first + 10 : first + 14] = (
            rng.uniform(0.05, 0.3),
            *rng.uniform(0.5, 5.0, 2),
            rng.uniform(-0.3, 0.3),
        )
    extra = len(parameters) - 14 * model.robot.joint_count
    parameters[len(parameters) - extra :] = rng.uniform(0.05, 0.5, extra)
    return model, parameters, _body(rng, 5.0)


def _body(rng: np.random.Generator, mass: float) -> FloatArray:
    centre = rng.uniform(-0.1, 0.1, 3)
    centre_outer = np.outer(centre, centre)
    inertia = mass * (np.eye(3) * (0.06**2 + centre @ centre) - centre_outer)
    return np.concatenate((inertia[np.triu_indices(3)], mass * centre, [mass]))


def _conditioning(model: Model) -> Conditioning:
    still = tuple(
        0.005 if joint.kind is JointKind.PRISMATIC else 0.03 for joint in model.robot.joints
    )
    return Conditioning(standstill_rad_s=still)


@cache
def _runs(urdf: str, gravity: Gravity) -> tuple[Run, Run]:
    """Without and with the payload; the current is exactly what the model needs for the filtered
    motion.
    """
    kind = next(kind for kind in (*KINDS, *HEAVY) if kind.urdf == urdf)
    model, parameters, payload = _truth(urdf, gravity)
    rng = np.random.default_rng(4)
    made = []
    for mounted in (None, Payload("body", "a", {"m": 5.0})):
        q = positions(rng, 22.0, RATE_HZ, kind.reach)
        time_s = np.arange(len(q)) / RATE_HZ
        current_a = np.zeros_like(q)
        bare = Run(
            "loaded" if mounted else "bare",
            time_s,
            q,
            current_a,
            mounted,
        )
        data = differentiate(bare, model.drive_train, _conditioning(model))
        total = parameters.copy()
        if mounted is not None:
            total[model.flange] += payload
        torque = np.einsum("jck,c->jk", model.regressor(data.motion()), total)
        current = np.zeros_like(q)
        current[1:-1] = ((model.drive_train.to_motor @ torque) / kind.gains[:, None]).T
        run = Run(bare.name, bare.time_s, q, current, mounted)
        made.append(run)
    return made[0], made[1]


def _fit(model: Model, runs: tuple[Run, ...], still: tuple[float, ...] | None = None) -> Estimate:
    conditioning = _conditioning(model)
    return identify(
        model, runs, conditioning if still is None else Conditioning(standstill_rad_s=still)
    ).estimate


@pytest.mark.parametrize(("kind", "gravity"), CASES, ids=_name)
def test_without_noise_the_gains_are_exact(kind: Kind, gravity: Gravity) -> None:
    model, _, payload = _truth(kind.urdf, gravity)
    runs = _runs(kind.urdf, gravity)
    estimate = _fit(model, runs)
    assert estimate.gains == pytest.approx(kind.gains, rel=1e-6)
    names = [column.name for column in estimate.unknowns]
    for name in ("mx", "my", "mz"):
        found = estimate.parameters[names.index(f"{name}:a")]
        assert found == pytest.approx(payload[LINK_PARAMETERS.index(name)], rel=1e-4, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=_name)
@settings(deadline=None, max_examples=3)
@given(data=st.data())
def test_permuting_the_motors_permutes_the_gains_and_nothing_else(
    kind: Kind, data: st.DataObject
) -> None:
    """Motor constants g/N, motor torque for a unit of current.

    N is that of the joint of the motor's number.
    """
    model, _, _ = _truth(kind.urdf, UPRIGHT)
    rng = np.random.default_rng(9)
    runs = tuple(
        replace(
            run, current_a=run.current_a * (1 + 0.02 * rng.standard_normal(run.current_a.shape))
        )
        for run in _runs(kind.urdf, UPRIGHT)
    )
    order = np.array(data.draw(st.permutations(range(len(kind.gains)))))
    train = DriveTrain(kind.ratio[order])
    shuffled = tuple(replace(run, current_a=run.current_a[:, order]) for run in runs)
    # One speed for all: which rows count must not depend on the order either.
    still = (0.02,) * len(order)
    before = _fit(model, runs, still)
    after = _fit(Model(model.robot, train), shuffled, still)
    per_motor = before.gains / model.drive_train.reduction
    assert after.gains / train.reduction == pytest.approx(per_motor[order], rel=1e-6)
    absolute_reduction = np.abs(model.drive_train.reduction)
    spread = before.gains_std / absolute_reduction
    assert after.gains_std / np.abs(train.reduction) == pytest.approx(spread[order], rel=1e-4)
    known = dict(zip((c.name for c in before.unknowns), before.parameters, strict=True))
    found = dict(zip((c.name for c in after.unknowns), after.parameters, strict=True))
    links = {
        name
        for name in known.keys() & found.keys()
        if name.startswith(("I", "m")) and "Iam" not in name
    }
    assert len(links) > 0.6 * sum(name.startswith(("I", "m")) for name in known)
    for name in links:
        assert found[name] == pytest.approx(known[name], rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize("kind", KINDS, ids=_name)
def test_the_mounting_must_be_declared(kind: Kind) -> None:
    """Data of a leaning robot, fitted as an upright one: the residual shows it."""
    leaning, _, _ = _truth(kind.urdf, LEANING)
    upright, _, _ = _truth(kind.urdf, UPRIGHT)
    bare = _runs(kind.urdf, LEANING)[:1]
    right, wrong = (
        identify(
            model, bare, _conditioning(model), method=Method.LS, fixed_gains=kind.gains
        ).training_error.total
        for model in (leaning, upright)
    )
    assert right < 1e-4
    # The offsets of prismatic axes take most of a wrong weight: 1.1 % on the gantry, above 40 % on
    # the arms.
    assert wrong > 0.5


def test_prismatic_joints_have_newton_for_their_friction() -> None:
    model, _, _ = _truth("gantry.urdf", UPRIGHT)
    units = {column.name: column.unit for column in model.columns}
    expected = ("kg", "N/(m/s)", "N", "N")
    assert (units["Ia1"], units["fv1"], units["fs1"], units["off1"]) == expected
    assert (units["Ia4"], units["fv4"], units["fs4"], units["off4"]) == (
        "kg m²",
        "Nm/(rad/s)",
        "Nm",
        "Nm",
    )
