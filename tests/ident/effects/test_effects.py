"""Every effect declares a property of its columns; one test tries to refute them all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from ident.discovery.structure import VARIABLES
from ident.effects.dictionary import EFFECTS, GEOMETRY, SECOND_JOINTS
from ident.effects.effect import Effect, GearSide, PlacedEffect, Property, at_joints, is_placeable
from ident.effects.electrical import Cogging, Lag, Saturation, TimeSkew
from ident.effects.friction import (
    AsymmetricViscous,
    Coupling,
    LoadFriction,
    PositionFriction,
    Stribeck,
)
from ident.effects.position import Hinge, Spring
from ident.effects.rotor import beside_rotors
from ident.effects.signals import Abscissa, Signals
from ident.effects.transmission import Efficiency, Elasticity, InertialCoupling
from ident.effects.unnamed import INTERVALS, Periodic, Smooth
from ident.model.model import DriveTrain
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import GANTRY, THREE_AXES

FloatArray = NDArray[np.float64]

JOINTS = 13
SAMPLES = 400


def random_signals(seed: int) -> Signals:
    """Signals of thirteen joints without mechanics between them."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(6, JOINTS, SAMPLES))
    position, velocity, acceleration, load, motor, geared = normal
    inertia = rng.normal(size=(JOINTS, JOINTS, SAMPLES))
    warming = rng.normal(size=(JOINTS, SAMPLES))
    motor_torque_nm = np.cumsum(motor, axis=1)
    time_s = np.arange(SAMPLES) / 100.0
    return Signals(
        rate_hz=100.0,
        time_s=time_s,
        session_s=5.0 + time_s,
        position_rad=2.0 * position,
        velocity_rad_s=velocity,
        acceleration_rad_s2=acceleration,
        motor_position_rad=30.0 * position,
        inertia_kg_m2=inertia,
        load_torque_nm=load,
        geared_torque_nm=geared,
        motor_torque_nm=motor_torque_nm,
        current_a=motor_torque_nm / 20.0,
        temperature_c=45.0 + 5.0 * warming,
    )


#: Signals that a smooth effect can depend on
SMOOTH_SIGNALS = (
    "time_s",
    "session_s",
    "position_rad",
    "velocity_rad_s",
    "motor_position_rad",
    "load_torque_nm",
    "motor_torque_nm",
    "current_a",
)
#: Signals of which each axis has its own
SIGNALS_OF_AXES = (
    "position_rad",
    "velocity_rad_s",
    "acceleration_rad_s2",
    "motor_position_rad",
    "load_torque_nm",
    "geared_torque_nm",
    "motor_torque_nm",
    "current_a",
)


def _scaled(s: Signals, factor: float) -> Signals:
    scaled = {}
    for name in SMOOTH_SIGNALS:
        signal = getattr(s, name)
        scaled[name] = factor * signal
    return replace(s, **scaled)


def _over_its_range(variable: Abscissa, signed: int, other_axis: int = 0) -> Smooth:
    other = None
    if other_axis:
        other = other_axis - 1
    signals = random_signals(5)
    x = np.abs(signals.variable(variable, 0, other))
    lower = float(np.quantile(x, 0.05))
    upper = float(np.quantile(x, 0.95))
    return Smooth(variable, lower, upper, signed, other_axis)


def _generic_families() -> Iterator[tuple[Effect, ...]]:
    for variable, signs in VARIABLES:
        family = [_over_its_range(variable, signed) for signed in signs]
        yield tuple(family)
    other = Abscissa.OTHER_VELOCITY
    unsigned = _over_its_range(other, 0, other_axis=4)
    signed = _over_its_range(other, 1, other_axis=4)
    yield (unsigned, signed)
    yield (Periodic(0), Periodic(1))


GENERIC = tuple(_generic_families())
FAMILIES = (*EFFECTS, *GENERIC)
ALL_EFFECTS = tuple(chain.from_iterable(FAMILIES))


def _members() -> Iterator[Any]:
    for family in FAMILIES:
        for index, effect in enumerate(family):
            yield pytest.param(effect, id=f"{effect.name}-{index}")


MEMBERS = list(_members())


def _largest(values: FloatArray) -> float:
    absolute = np.abs(values)
    return float(np.max(absolute))


def _same(one: FloatArray, other: FloatArray) -> bool:
    # A motor angle of a hundred radians and the square of a rate each cost some digits.
    tolerance = 1e-10 * _largest(other) + 1e-12
    return np.allclose(one, other, rtol=1e-8, atol=tolerance)


def _is_odd(before: FloatArray, reversed_: FloatArray) -> bool:
    is_seen = bool(np.any(before))
    return is_seen and _same(reversed_, -before)


def _is_zero_where_constant(free: FloatArray, stopped: FloatArray) -> bool:
    """Whether columns are zero where a signal was constant over the middle half.

    A filter, forwards or backwards in time, has forgotten the rest in its middle.
    """
    centre = SAMPLES // 2
    middle = stopped[..., centre - 5 : centre + 5]
    is_seen = bool(np.any(free))
    return is_seen and _largest(middle) <= 1e-7 * _largest(free)


def _stopped(value: FloatArray) -> FloatArray:
    """A signal that is constant over the middle half."""
    stopped = value.copy()
    quarter = SAMPLES // 4
    stopped[:, quarter:-quarter] = 1.5
    return stopped


def _claim_holds(effect: Effect, claim: Property, axis: int, seed: int) -> bool:
    """Whether a property can be seen in an effect's columns;
    what it is said of must have a say in them.
    """
    s = random_signals(seed)
    velocity = s.velocity_rad_s
    angle = s.motor_position_rad
    columns = effect.columns(s, axis)

    def changed(**signals: Any) -> FloatArray:
        """Columns with other signals."""
        other = replace(s, **signals)
        return effect.columns(other, axis)

    match claim:
        case Property.ODD_IN_VELOCITY:
            reversed_ = changed(velocity_rad_s=-velocity)
            holds = _is_odd(columns, reversed_)
        case Property.EVEN_IN_VELOCITY:
            doubled = changed(velocity_rad_s=2.0 * velocity)
            reversed_ = changed(velocity_rad_s=-velocity)
            is_seen = not _same(doubled, columns)
            holds = is_seen and _same(reversed_, columns)
        case Property.INDEPENDENT_OF_VELOCITY:
            at_another = changed(velocity_rad_s=3.0 + velocity**2)
            holds = _same(at_another, columns)
        case Property.PERIODIC_IN_MOTOR_ANGLE:
            turned = changed(motor_position_rad=angle + 0.3)
            turned_once = changed(motor_position_rad=angle + 2.0 * np.pi)
            is_seen = not _same(turned, columns)
            holds = is_seen and _same(turned_once, columns)
        case Property.ODD_IN_CURRENT:
            reversed_ = changed(motor_torque_nm=-s.motor_torque_nm, current_a=-s.current_a)
            holds = _is_odd(columns, reversed_)
        case Property.ODD_IN_LOAD:
            reversed_ = changed(
                load_torque_nm=-s.load_torque_nm, geared_torque_nm=-s.geared_torque_nm
            )
            holds = _is_odd(columns, reversed_)
        case Property.RATE_OF_TORQUE:
            stopped_nm = _stopped(s.motor_torque_nm)
            stopped = changed(motor_torque_nm=stopped_nm)
            holds = _is_zero_where_constant(columns, stopped)
        case Property.RATE_OF_LOAD:
            stopped_nm = _stopped(s.load_torque_nm)
            stopped = changed(load_torque_nm=stopped_nm)
            holds = _is_zero_where_constant(columns, stopped)
        case Property.SMOOTH:
            # A uniform cubic spline's slope is less than one an interval, and no variable here is
            # more than a hundred times its range; a change by a small part of itself turns no sign.
            scaled = _scaled(s, 1.0 + 1e-8)
            change = effect.columns(scaled, axis) - columns
            is_seen = bool(np.any(change))
            largest_change = 1e-8 * 100.0 * INTERVALS
            holds = is_seen and _largest(change) <= largest_change
    return holds


@pytest.mark.parametrize("effect", MEMBERS)
def test_claims_hold(effect: Effect) -> None:
    for seed in range(3):
        assert _claim_holds(effect, effect.declares, 0, seed)


WRONG: tuple[tuple[Effect, Property], ...] = (
    (AsymmetricViscous(), Property.ODD_IN_VELOCITY),
    (Spring(), Property.ODD_IN_VELOCITY),
    (Stribeck(0.1), Property.EVEN_IN_VELOCITY),
    (Spring(), Property.EVEN_IN_VELOCITY),
    (LoadFriction(0), Property.INDEPENDENT_OF_VELOCITY),
    (Coupling(2, -1), Property.INDEPENDENT_OF_VELOCITY),
    (Hinge(0.5, 1), Property.PERIODIC_IN_MOTOR_ANGLE),
    (Saturation(), Property.PERIODIC_IN_MOTOR_ANGLE),
    (Cogging(2), Property.ODD_IN_CURRENT),
    (LoadFriction(0), Property.ODD_IN_LOAD),
    (Elasticity(), Property.RATE_OF_TORQUE),
    (Saturation(), Property.RATE_OF_TORQUE),
    (LoadFriction(0), Property.RATE_OF_LOAD),
    (Spring(), Property.RATE_OF_LOAD),
    (Cogging(10**9), Property.SMOOTH),
)


@pytest.mark.parametrize(("effect", "claim"), WRONG, ids=lambda value: getattr(value, "name", None))
def test_a_wrong_claim_is_refuted(effect: Effect, claim: Property) -> None:
    assert not _claim_holds(effect, claim, 0, 0)


def test_every_property_can_be_refuted_and_is_claimed_by_someone() -> None:
    # Corrections of the geometry are tested against an arm (test_geometry.py); these signals have
    # none.
    of_signals = set(Property) - {Property.TURNS_THE_ARM}
    claims = {claim for _, claim in WRONG}
    assert claims == of_signals
    declares = {effect.declares for effect in ALL_EFFECTS}
    assert declares == of_signals
    geometry = chain.from_iterable(GEOMETRY)
    of_geometry = {effect.declares for effect in geometry}
    assert of_geometry == {Property.TURNS_THE_ARM}


@pytest.mark.parametrize("effect", MEMBERS)
def test_columns_are_as_many_as_coefficients_and_belong_to_their_axes(effect: Effect) -> None:
    signals = random_signals(5)
    columns = effect.columns(signals, 0)
    joints = _joints_of_columns(effect)
    count = len(effect.coefficients)
    assert columns.shape == (*joints, count, SAMPLES)
    assert np.all(np.isfinite(columns))

    is_moving = np.ptp(columns, axis=-1) > 0
    if effect.name == "cable":  # each stiffness of one joint alone acts on that joint
        is_moving = is_moving.any(axis=0)
    is_spring = effect.name == "passive-spring"
    is_constant = [is_spring and column.name == "preload" for column in effect.coefficients]
    is_as_declared = is_moving | np.array(is_constant)
    assert np.all(is_as_declared)

    own = _own_axes(effect)
    others = [axis for axis in range(JOINTS) if axis not in own]
    others_changed = _with_other_signals(signals, others)
    assert np.array_equal(effect.columns(others_changed, 0), columns)
    # What depends on the clock alone is the same on all axes.
    own_changed = _with_other_signals(signals, own)
    is_signed = bool(effect.settings.get("signed"))
    if is_signed or not _is_of_the_clock(effect):
        assert not np.allclose(effect.columns(own_changed, 0), columns)


def _is_of_the_clock(effect: Effect) -> bool:
    """Whether an effect depends on the time alone, where it has no sign of the velocity."""
    is_by_time = effect.abscissa in {Abscissa.TIME, Abscissa.SESSION}
    without_motion = {Property.SMOOTH, Property.INDEPENDENT_OF_VELOCITY}
    return is_by_time and effect.declares in without_motion


def _joints_of_columns(effect: Effect) -> tuple[int, ...]:
    """The axis of an effect's columns that is over the joints, where it has one."""
    if effect.side is GearSide.TWO_JOINTS:
        return (2,)
    if effect.side in {GearSide.ALL_JOINTS, GearSide.ALL_MOTORS}:
        return (JOINTS,)
    return ()


def _own_axes(effect: Effect) -> list[int]:
    """Axes of which the signals are in an effect's columns on the first axis."""
    if effect.side is GearSide.ALL_MOTORS:
        return list(range(JOINTS))
    other_axis = int(effect.settings.get("other_axis", 0))
    if other_axis:
        return [0, other_axis - 1]
    return [0]


def _with_other_signals(signals: Signals, axes: list[int]) -> Signals:
    """The signals, with those of these axes taken from another recording."""
    others = random_signals(6)
    mixed = {}
    for name in SIGNALS_OF_AXES:
        other = getattr(others, name)
        signal = getattr(signals, name).copy()
        signal[axes] = other[axes]
        mixed[name] = signal
    return replace(signals, **mixed)


def _stacked(*joints: FloatArray) -> Any:
    """Columns of each joint one over the other, about equal to others."""
    return pytest.approx(np.stack(joints))


def test_columns_act_where_the_effect_says() -> None:
    ratio = np.diag([30.0, 40.0, 50.0])
    ratio[2, 1] = 25.0
    train = DriveTrain(ratio)
    rng = np.random.default_rng(1)
    of_axis = rng.normal(size=(2, 7))
    of_pair = rng.normal(size=(2, 2, 7))
    of_all = rng.normal(size=(3, 1, 7))
    none = np.zeros((2, 7))

    # Motor 3 turns with joints 2 and 3, the second at half the ratio.
    at_motor_3 = at_joints(Cogging(1), 2, of_axis, train)
    assert at_motor_3 == _stacked(none, 0.5 * of_axis, of_axis)
    at_joint_2 = at_joints(Spring(), 1, of_axis, train)
    assert at_joint_2 == _stacked(none, of_axis, none)
    at_joints_1_and_3 = at_joints(Coupling(3, 1), 0, of_pair, train)
    assert at_joints_1_and_3 == _stacked(of_pair[0], none, of_pair[1])
    at_all_joints = at_joints(Elasticity(), 1, of_all, train)
    assert np.array_equal(at_all_joints, of_all)
    at_all_motors = at_joints(TimeSkew(), 0, of_all, train)
    of_motor_1, of_motor_2, of_motor_3 = of_all
    of_motors_2_and_3 = of_motor_2 + 0.5 * of_motor_3
    assert at_all_motors == _stacked(of_motor_1, of_motors_2_and_3, of_motor_3)


def test_a_pair_is_named_by_its_lower_axis_and_only_angles_have_a_sine() -> None:
    three = robot_from_urdf(THREE_AXES.urdf)
    gantry = robot_from_urdf(GANTRY.urdf)
    pair = Coupling(3, 1)
    coupled = [axis for axis in range(3) if is_placeable(pair, axis, three)]
    assert coupled == [0, 1]
    beyond = Coupling(4, 1)
    assert not is_placeable(beyond, 0, three)
    assert is_placeable(Spring(), 2, three)
    # What all motors share is tried once.
    skew = TimeSkew()
    skewed = [axis for axis in range(3) if is_placeable(skew, axis, three)]
    assert skewed == [0]
    sine = PositionFriction()
    assert is_placeable(sine, 0, three)
    assert not is_placeable(sine, 0, gantry)
    assert is_placeable(Spring(), 0, gantry)


def test_families_hold_one_name_and_names_are_unique() -> None:
    names = set()
    for family in EFFECTS:
        (name,) = {effect.name for effect in family}
        names.add(name)
    assert len(names) == len(EFFECTS)


@dataclass(frozen=True, slots=True)
class Cubic(AsymmetricViscous):
    """τ = c q̇³: nonlinear-viscous with exponent 3, under a name of its own."""

    name = "cubic"

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        cube = signals.velocity_rad_s[axis] ** 3
        return np.asarray(cube)[None]


@dataclass(frozen=True, slots=True)
class Span:
    """What the columns of an effect span on the robot's joints."""

    effect: Effect
    directions: FloatArray  #: orthonormal, shape (p, joints and samples)

    @property
    def label(self) -> str:
        """Name and settings."""
        values = self.effect.settings.values()
        settings = ", ".join(f"{value:g}" for value in values)
        return f"{self.effect.name} ({settings})"

    def is_duplicate_of(self, other: Span) -> bool:
        """Whether the columns of one are in what the columns of the other span."""
        if self.effect.with_motor != other.effect.with_motor:  # never on the same joint
            return False
        products = self.directions @ other.directions.T
        cosines = np.linalg.svd(products, compute_uv=False)
        return bool(cosines[-1] > 1.0 - 1e-9)


def _span(effect: Effect, runs: tuple[Signals, ...], train: DriveTrain) -> Span:
    torque_of_runs = []
    for run in runs:
        columns = effect.columns(run, 0)
        torque_of_run = at_joints(effect, 0, columns, train)
        torque_of_runs.append(torque_of_run)
    torque = np.concatenate(torque_of_runs, axis=-1)
    # joint, parameter, sample → parameter, joint and sample
    of_parameters = np.moveaxis(torque, 1, 0)
    flat = of_parameters.reshape(len(of_parameters), -1)
    _, _, directions = np.linalg.svd(flat, full_matrices=False)
    return Span(effect, directions)


def _duplicates(families: tuple[tuple[Effect, ...], ...]) -> list[tuple[str, str]]:
    """Pairs of effects of which one's columns span the other's on the robot's joints:
    they cannot be distinguished.
    """
    ratios = np.linspace(30.0, 50.0, JOINTS)
    train = DriveTrain(np.diag(ratios))
    first_run = random_signals(5)
    later_run = random_signals(6)
    later_run = replace(later_run, session_s=300.0 + later_run.time_s)
    runs = (first_run, later_run)
    effects = chain.from_iterable(families)
    spans = [_span(effect, runs, train) for effect in effects]
    duplicates = []
    for one, other in combinations(spans, 2):
        if one.is_duplicate_of(other):
            duplicates.append((one.label, other.label))
    return duplicates


@pytest.mark.slow
def test_no_two_effects_are_the_same_under_two_names() -> None:
    of_one_joint = [("spring ()", f"cable ({other})") for other in SECOND_JOINTS]
    forms = [("saturation (0)", "saturation (1)")]  # with one term and with two
    assert _duplicates(EFFECTS) == [*of_one_joint, *forms]
    same = [("nonlinear-viscous (3)", "cubic ()")]
    families = (*EFFECTS, (Cubic(),))
    assert _duplicates(families) == [*same, *of_one_joint, *forms]


@pytest.mark.parametrize("backwards", [0, 1])
def test_the_rate_behind_a_filter_is_that_of_its_equation(backwards: int) -> None:
    """T ẏ + y = τ of a ramp that begins at t₀ has ẏ = 1 − exp(−(t − t₀)/T); of a constant, none."""
    rate_hz = 500.0
    filter_s = 0.012
    start = 100
    time_s = (np.arange(300) - start) / rate_hz  # since t₀
    constant = np.full(300, 7.0)
    ramp = np.maximum(time_s, 0.0)
    rate = -np.expm1(-ramp / filter_s)
    if backwards:
        ramp = ramp[::-1]
        rate = -rate[::-1]
    effect = Lag(filter_s, backwards)
    torque_nm = np.stack((ramp, constant))
    signals = replace(random_signals(1), rate_hz=rate_hz, motor_torque_nm=torque_nm)
    of_ramp = effect.columns(signals, 0)
    assert of_ramp[0] == pytest.approx(-rate, abs=1e-9)
    of_constant = effect.columns(signals, 1)
    assert of_constant == pytest.approx(0.0, abs=1e-9)


def test_with_no_filter_it_is_the_central_difference() -> None:
    signals = random_signals(1)
    torque_nm = signals.motor_torque_nm[2]
    slope = signals.rate_hz * np.gradient(torque_nm)
    of_lag = Lag().columns(signals, 2)
    of_skew = TimeSkew().columns(signals, 0)
    assert of_lag[0] == pytest.approx(-slope)
    assert of_skew[2, 0] == pytest.approx(-slope)


@pytest.mark.parametrize(
    "effect",
    [LoadFriction(0, 0.4, 1), LoadFriction(1, 0.4, 1), Efficiency(0.5, 0.4, 1)],
    ids=lambda one: one.name,
)
def test_the_rest_of_a_rotor_is_the_derivative_of_a_loss(effect: LoadFriction | Efficiency) -> None:
    s = random_signals(3)
    axis = 2
    step = 1e-7

    def without_rotor(rotor_kg_m2: float, signals: Signals) -> FloatArray:
        one_column = replace(effect, rotor_inertia_kg_m2=rotor_kg_m2, with_rotor=0)
        (column,) = one_column.columns(signals, axis)
        return np.asarray(column)

    loss, rest = effect.columns(s, axis)
    more = without_rotor(0.4 + step, s)
    less = without_rotor(0.4 - step, s)
    derivative = (more - less) / (2.0 * step)
    assert_allclose(rest, derivative, atol=1e-6)
    rotor_torque_nm = 0.4 * s.acceleration_rad_s2
    without_rotor_torque = replace(
        s,
        load_torque_nm=s.load_torque_nm - rotor_torque_nm,
        geared_torque_nm=s.geared_torque_nm - rotor_torque_nm,
    )
    loss_of_link = without_rotor(0.0, without_rotor_torque)
    assert_allclose(loss, loss_of_link, atol=1e-12)


def test_effects_behind_the_gear_leave_a_known_rotor_out() -> None:
    s = random_signals(4)
    axis = 2
    rotor_kg_m2 = 0.3
    friction = LoadFriction(0, rotor_kg_m2, 1)
    loss = PlacedEffect(friction, axis)
    elasticity = Elasticity()
    on_another_axis = PlacedEffect(elasticity, 1)
    known = beside_rotors(s, (on_another_axis, loss))

    turning_nm = rotor_kg_m2 * s.acceleration_rad_s2[axis]
    link_torque_nm = s.load_torque_nm[axis] - turning_nm
    gear_torque_nm = s.geared_torque_nm[axis] - turning_nm
    assert_allclose(known.link_torque(axis), link_torque_nm)
    assert_allclose(known.gear_torque(axis), gear_torque_nm)
    assert_allclose(known.variable(Abscissa.LOAD, axis), link_torque_nm)
    assert_allclose(known.link_torque(1), s.load_torque_nm[1])

    every = slice(None)
    column = s.inertia(every, axis).copy()
    column[axis] -= rotor_kg_m2
    assert_allclose(known.inertia(every, axis), column)
    own_inertia = s.inertia(axis, axis) - rotor_kg_m2
    assert_allclose(known.inertia(axis, axis), own_inertia)
    assert_array_equal(known.inertia(every, 1), s.inertia(every, 1))

    friction_with_known = friction.columns(known, axis)
    assert_array_equal(friction_with_known, friction.columns(s, axis))
    elasticity_with_known = elasticity.columns(known, axis)
    assert not np.allclose(elasticity_with_known, elasticity.columns(s, axis))
    without_rotor = PlacedEffect(LoadFriction(0), axis)
    assert beside_rotors(s, (without_rotor,)) is s


def test_an_inertial_coupling_against_its_variable_is_a_straight_line() -> None:
    """A picture of it against the velocity would be a cloud."""
    signals = random_signals(7)
    coupling = InertialCoupling(4)
    on_both_nm = coupling.columns(signals, 1)
    on_own_joint_nm = on_both_nm[0, 0]
    along = signals.variable(coupling.abscissa, 1, other=3)
    assert np.array_equal(on_own_joint_nm, along)
