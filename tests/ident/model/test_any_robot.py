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
"""Ratio of a screw with a lead of 20 mm [rad/m]."""
BELT = 5.0 * 2.0 * np.pi / 0.15
"""Ratio of a gear of 5 before a belt that moves by 150 mm a turn [rad/m]."""
JOINT_COLUMNS = 14  #: parameters of a joint: 10 of its link, then Ia, fv, fs and off


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


Couplings = dict[tuple[int, int], float]


def _with(diagonal: list[float], entries: Couplings) -> FloatArray:
    ratio = np.diag(diagonal)
    for place, value in entries.items():
        ratio[place] = value
    return ratio


# A coupled wrist, as the paper's: motor 6 also turns with joint 5.
TX40_RATIO = _with([32, 32, 45, -48, 45, 32], {(5, 4): 32})
TX40_GAINS = np.array([33.9, 32.4, 24.2, -9.21, 16.3, 6.79])
TX40_REACH = np.array([2.5, 1.8, 2.0, 3.0, 1.8, 3.0])
TX40 = Kind(
    "tx40.urdf",
    TX40_RATIO,
    TX40_GAINS,
    TX40_REACH,
)

# A differential: motors 6 and 7 turn together with joint 6, against each other with joint 7.
SEVEN_AXIS_COUPLINGS: Couplings = {
    (5, 6): 50,
    (6, 5): 50,
}
SEVEN_AXIS_RATIO = _with([100, 100, 80, -80, 60, 50, -50], SEVEN_AXIS_COUPLINGS)
SEVEN_AXIS_GAINS = np.array([43.2, 39.6, 27.5, -24.8, 14.9, 7.75, -8.6])
SEVEN_AXIS_REACH = np.array([2.5, 1.8, 2.5, 1.9, 2.5, 1.8, 2.9])
SEVEN_AXIS = Kind(
    "seven-axis.urdf",
    SEVEN_AXIS_RATIO,
    SEVEN_AXIS_GAINS,
    SEVEN_AXIS_REACH,
)

# One belt for X and Y, a screw for Z, and a wrist motor that turns with both of its joints.
GANTRY_COUPLINGS: Couplings = {
    (0, 1): BELT,
    (1, 0): BELT,
    (4, 3): -50,
}
GANTRY_RATIO = _with([BELT, -BELT, SCREW, 80, 50], GANTRY_COUPLINGS)
GANTRY_GAINS = np.array([109.3, -101.2, 149.8, 12.7, 6.6])
GANTRY_REACH = np.array([0.7, 0.45, 0.25, 3.0, 1.8])
GANTRY = Kind(
    "gantry.urdf",
    GANTRY_RATIO,
    GANTRY_GAINS,
    GANTRY_REACH,
)
KINDS = (TX40, SEVEN_AXIS, GANTRY)

RX90_RATIO = _with([128, 128, 101, -75, 75, 60], {(5, 4): 60})
RX90_GAINS = np.array([44.1, 40.1, 33.6, -16.1, 18.2, 10.9])
RX90_REACH = np.array([2.5, 1.6, 2.2, 3.0, 1.8, 3.0])
RX90 = Kind(
    "rx90.urdf",
    RX90_RATIO,
    RX90_GAINS,
    RX90_REACH,
)

# An in-line wrist: motor 5 also turns with joint 4, motor 6 with joints 4 and 5.
KR270_REDUCTIONS = [256.857, 267.429, 252.333, 221, 239.619, 154.323]
KR270_COUPLINGS = {
    (4, 3): -59.905,
    (5, 3): 38.581,
    (5, 4): -51.441,
}
KR270_RATIO = _with(KR270_REDUCTIONS, KR270_COUPLINGS)
KR270_GAINS = np.array([353.2, 344.5, 320.4, 196.1, 195.3, 137.6])
KR270_REACH = np.array([2.0, 1.1, 2.2, 3.0, 2.0, 3.0])
KR270 = Kind(
    "kr270.urdf",
    KR270_RATIO,
    KR270_GAINS,
    KR270_REACH,
)
HEAVY = (RX90, KR270)
"""Beside these: in a chain of couplings a motor in another's place belongs to another joint,
so that other rows count; and a heavy arm that leans is refused, not only fitted badly.
"""
ALL_KINDS = (*KINDS, *HEAVY)
CASES = list(product(ALL_KINDS, (UPRIGHT, LEANING)))


def _kind(urdf: str) -> Kind:
    kinds = {kind.urdf: kind for kind in ALL_KINDS}
    return kinds[urdf]


def _name(value: object) -> str:
    if isinstance(value, Kind):
        return value.urdf.removesuffix(".urdf")
    if value == UPRIGHT:
        return "upright"
    return "leaning"


@cache
def _truth(urdf: str, gravity: Gravity) -> tuple[Model, FloatArray, FloatArray]:
    """Model, standard parameters, and the inertial ones of a payload of 5 kg about the last joint's
    frame.
    """
    path = CONFIGS / "robots" / urdf
    robot = robot_from_urdf(path.read_text(), gravity)
    drive_train = DriveTrain(_kind(urdf).ratio)
    model = Model(robot, drive_train)
    rng = np.random.default_rng(len(urdf))
    parameters = np.zeros(len(model.columns))
    for joint in range(robot.joint_count):
        mass = rng.uniform(1.0, 8.0)
        link = _body(rng, mass)
        drive = _drive(rng)
        first = JOINT_COLUMNS * joint
        end = first + JOINT_COLUMNS
        of_joint = np.concatenate((link, drive))
        parameters[first:end] = of_joint
    # Rotors and friction of coupled motors follow those of the joints.
    first_coupled = JOINT_COLUMNS * robot.joint_count
    coupled = parameters[first_coupled:]
    coupled[:] = rng.uniform(0.05, 0.5, coupled.size)
    payload = _body(rng, 5.0)
    return model, parameters, payload


def _body(rng: np.random.Generator, mass: float) -> FloatArray:
    """Inertial parameters of a body about its frame, in the order of LINK_PARAMETERS."""
    centre = rng.uniform(-0.1, 0.1, 3)
    gyration_m = 0.06
    # Parallel axes: I = m ((r² + |c|²) E − c cᵀ).
    square = gyration_m**2 + centre @ centre
    diagonal = square * np.eye(3)
    products = np.outer(centre, centre)
    inertia = mass * (diagonal - products)
    upper = inertia[np.triu_indices(3)]
    moment = mass * centre
    return np.concatenate((upper, moment, [mass]))


def _drive(rng: np.random.Generator) -> FloatArray:
    """Rotor inertia, viscous and dry friction and offset of a joint's own motor."""
    rotor = rng.uniform(0.05, 0.3)
    viscous, dry = rng.uniform(0.5, 5.0, 2)
    offset = rng.uniform(-0.3, 0.3)
    return np.array([rotor, viscous, dry, offset])


def _conditioning(model: Model) -> Conditioning:
    standstill_of = {JointKind.PRISMATIC: 0.005, JointKind.REVOLUTE: 0.03}
    joints = model.robot.joints
    standstill = [standstill_of[joint.kind] for joint in joints]
    return Conditioning(standstill_rad_s=tuple(standstill))


@cache
def _runs(urdf: str, gravity: Gravity) -> tuple[Run, Run]:
    """Without and with the payload; the current is exactly what the model needs for the filtered
    motion.
    """
    kind = _kind(urdf)
    model, parameters, payload = _truth(urdf, gravity)
    rng = np.random.default_rng(4)
    mounted = Payload("body", "a", {"m": 5.0})
    loaded_parameters = parameters.copy()
    loaded_parameters[model.flange] += payload
    bare = _run("bare", None, kind, model, parameters, rng)
    loaded = _run("loaded", mounted, kind, model, loaded_parameters, rng)
    return bare, loaded


def _run(
    name: str,
    mounted: Payload | None,
    kind: Kind,
    model: Model,
    parameters: FloatArray,
    rng: np.random.Generator,
) -> Run:
    q = positions(rng, 22.0, RATE_HZ, kind.reach)
    samples = np.arange(len(q))
    time_s = samples / RATE_HZ
    no_current = np.zeros_like(q)
    run = Run(name, time_s, q, no_current, mounted)
    data = differentiate(run, model.drive_train, _conditioning(model))
    regressor = model.regressor(data.motion())
    joint_torque = np.einsum("jck,c->jk", regressor, parameters)
    motor_torque = model.drive_train.to_motor @ joint_torque
    gains = kind.gains[:, None]
    needed = motor_torque / gains
    current_a = np.zeros_like(q)
    current_a[1:-1] = needed.T
    return replace(run, current_a=current_a)


def _fit(
    model: Model, runs: tuple[Run, ...], standstill: tuple[float, ...] | None = None
) -> Estimate:
    conditioning = _conditioning(model)
    if standstill is not None:
        conditioning = Conditioning(standstill_rad_s=standstill)
    return identify(model, runs, conditioning).estimate


def _named_parameters(estimate: Estimate) -> dict[str, float]:
    names = (column.name for column in estimate.unknowns)
    return dict(zip(names, estimate.parameters, strict=True))


@pytest.mark.parametrize(("kind", "gravity"), CASES, ids=_name)
def test_without_noise_the_gains_are_exact(kind: Kind, gravity: Gravity) -> None:
    model, _, payload = _truth(kind.urdf, gravity)
    runs = _runs(kind.urdf, gravity)
    estimate = _fit(model, runs)
    assert estimate.gains == pytest.approx(kind.gains, rel=1e-6)
    parameters = _named_parameters(estimate)
    for name in ("mx", "my", "mz"):
        found = parameters[f"{name}:a"]
        place = LINK_PARAMETERS.index(name)
        expected = payload[place]
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)


def _is_link_parameter(name: str) -> bool:
    is_of_link_or_rotor = name.startswith(("I", "m"))
    return is_of_link_or_rotor and "Iam" not in name


def _with_noise(run: Run, rng: np.random.Generator) -> Run:
    noise = rng.standard_normal(run.current_a.shape)
    factor = 1 + 0.02 * noise
    return replace(run, current_a=run.current_a * factor)


def _in_order(run: Run, order: NDArray[np.intp]) -> Run:
    """The run of a robot with its motors in another order."""
    current_a = run.current_a[:, order]
    return replace(run, current_a=current_a)


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
    exact = _runs(kind.urdf, UPRIGHT)
    runs = tuple(_with_noise(run, rng) for run in exact)
    motors = range(len(kind.gains))
    permutation = data.draw(st.permutations(motors))
    order = np.array(permutation)
    shuffled = tuple(_in_order(run, order) for run in runs)
    shuffled_train = DriveTrain(kind.ratio[order])
    shuffled_model = Model(model.robot, shuffled_train)
    # One speed for all: which rows count must not depend on the order either.
    standstill = (0.02,) * len(order)

    before = _fit(model, runs, standstill)
    after = _fit(shuffled_model, shuffled, standstill)

    reduction = model.drive_train.reduction
    shuffled_reduction = shuffled_train.reduction
    constants = before.gains / reduction
    shuffled_constants = after.gains / shuffled_reduction
    assert shuffled_constants == pytest.approx(constants[order], rel=1e-6)
    std = before.gains_std / np.abs(reduction)
    shuffled_std = after.gains_std / np.abs(shuffled_reduction)
    assert shuffled_std == pytest.approx(std[order], rel=1e-4)
    known = _named_parameters(before)
    found = _named_parameters(after)
    in_both = known.keys() & found.keys()
    links = {name for name in in_both if _is_link_parameter(name)}
    with_rotors = [name for name in known if name.startswith(("I", "m"))]
    enough = 0.6 * len(with_rotors)
    assert len(links) > enough
    for name in links:
        expected = pytest.approx(known[name], rel=1e-5, abs=1e-6)
        assert found[name] == expected, name


@pytest.mark.parametrize("kind", KINDS, ids=_name)
def test_the_mounting_must_be_declared(kind: Kind) -> None:
    """Data of a leaning robot, fitted as an upright one: the residual shows it."""
    leaning, _, _ = _truth(kind.urdf, LEANING)
    upright, _, _ = _truth(kind.urdf, UPRIGHT)
    bare = _runs(kind.urdf, LEANING)[:1]

    def error_percent(model: Model) -> float:
        conditioning = _conditioning(model)
        identified = identify(model, bare, conditioning, method=Method.LS, fixed_gains=kind.gains)
        return identified.training_error.total

    right = error_percent(leaning)
    wrong = error_percent(upright)
    assert right < 1e-4
    # The offsets of prismatic axes take most of a wrong weight: 1.1 % on the gantry, above 40 % on
    # the arms.
    assert wrong > 0.5


def test_prismatic_joints_have_newton_for_their_friction() -> None:
    model, _, _ = _truth("gantry.urdf", UPRIGHT)
    units = {column.name: column.unit for column in model.columns}
    assert units["Ia1"] == "kg"
    assert units["fv1"] == "N/(m/s)"
    assert units["fs1"] == "N"
    assert units["off1"] == "N"
    assert units["Ia4"] == "kg m²"
    assert units["fv4"] == "Nm/(rad/s)"
    assert units["fs4"] == "Nm"
    assert units["off4"] == "Nm"
