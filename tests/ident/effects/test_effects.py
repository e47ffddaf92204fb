"""Every effect declares a property of its columns; one test tries to refute them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np
import pytest
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
    position, velocity, acceleration, load, motor, geared = rng.normal(size=(6, JOINTS, SAMPLES))
    torque = np.cumsum(motor, axis=1)
    time_s = np.arange(SAMPLES) / 100.0
    inertia_kg_m2 = rng.normal(size=(JOINTS, JOINTS, SAMPLES))
    temperature_c = 45.0 + 5.0 * rng.normal(size=(JOINTS, SAMPLES))
    session_s = 5.0 + time_s
    position_rad = 2.0 * position
    motor_position_rad = 30.0 * position
    current_a = torque / 20.0
    return Signals(
        rate_hz=100.0,
        time_s=time_s,
        session_s=session_s,
        position_rad=position_rad,
        velocity_rad_s=velocity,
        acceleration_rad_s2=acceleration,
        motor_position_rad=motor_position_rad,
        inertia_kg_m2=inertia_kg_m2,
        load_torque_nm=load,
        geared_torque_nm=geared,
        motor_torque_nm=torque,
        current_a=current_a,
        temperature_c=temperature_c,
    )


def _scaled(s: Signals, factor: float) -> Signals:
    time_s = factor * s.time_s
    session_s = factor * s.session_s
    position_rad = factor * s.position_rad
    velocity_rad_s = factor * s.velocity_rad_s
    motor_position_rad = factor * s.motor_position_rad
    load_torque_nm = factor * s.load_torque_nm
    motor_torque_nm = factor * s.motor_torque_nm
    current_a = factor * s.current_a
    return replace(
        s,
        time_s=time_s,
        session_s=session_s,
        position_rad=position_rad,
        velocity_rad_s=velocity_rad_s,
        motor_position_rad=motor_position_rad,
        load_torque_nm=load_torque_nm,
        motor_torque_nm=motor_torque_nm,
        current_a=current_a,
    )


def _over_its_range(variable: Abscissa, signed: int, other_axis: int = 0) -> Smooth:
    x = np.abs(random_signals(5).variable(variable, 0, other_axis - 1 if other_axis else None))
    lower = float(np.quantile(x, 0.05))
    upper = float(np.quantile(x, 0.95))
    return Smooth(variable, lower, upper, signed, other_axis)


def _generic_families() -> Iterator[tuple[Effect, ...]]:
    for variable, signs in VARIABLES:
        yield tuple(_over_its_range(variable, signed) for signed in signs)
    other = Abscissa.OTHER_VELOCITY
    yield tuple(_over_its_range(other, signed, other_axis=4) for signed in (0, 1))
    yield (Periodic(0), Periodic(1))


GENERIC = tuple(_generic_families())
ALL_EFFECTS = (*chain.from_iterable(EFFECTS), *chain.from_iterable(GENERIC))


def _members() -> Iterator[Any]:
    for family in (*EFFECTS, *GENERIC):
        for index, effect in enumerate(family):
            yield pytest.param(effect, id=f"{effect.name}-{index}")


MEMBERS = list(_members())


def _same(one: FloatArray, other: FloatArray) -> bool:
    # A motor angle of a hundred radians and the square of a rate each cost some digits.
    return np.allclose(one, other, rtol=1e-8, atol=1e-10 * float(np.max(np.abs(other))) + 1e-12)


def _is_odd(columns: Callable[[Signals], FloatArray], signals: Signals, reversed_: Signals) -> bool:
    return _same(columns(reversed_), -columns(signals)) and bool(np.any(columns(signals)))


def _is_zero_where(
    columns: Callable[[Signals], FloatArray], signals: Signals, held: Signals
) -> bool:
    """Held over the middle half: a filter, forwards or backwards in time,
    has forgotten the rest in its middle.
    """
    free = columns(signals)
    middle = columns(held)[..., SAMPLES // 2 - 5 : SAMPLES // 2 + 5]
    largest_absolute_middle = np.max(np.abs(middle))
    largest_absolute_free = np.max(np.abs(free))
    return bool(largest_absolute_middle <= 1e-7 * largest_absolute_free) and bool(np.any(free))


def _held(value: FloatArray) -> FloatArray:
    held = value.copy()
    held[:, SAMPLES // 4 : -SAMPLES // 4] = 1.5
    return held


def _claim_holds(effect: Effect, claim: Property, axis: int, seed: int) -> bool:
    """Whether a property can be seen in an effect's columns;
    what it is said of must have a say in them.
    """
    s = random_signals(seed)
    v = s.velocity_rad_s
    angle = s.motor_position_rad

    def columns(signals: Signals) -> FloatArray:
        return effect.columns(signals, axis)

    match claim:
        case Property.ODD_IN_VELOCITY:
            holds = _is_odd(columns, s, replace(s, velocity_rad_s=-v))
        case Property.EVEN_IN_VELOCITY:
            has_a_say = not _same(columns(replace(s, velocity_rad_s=2.0 * v)), columns(s))
            holds = has_a_say and _same(columns(replace(s, velocity_rad_s=-v)), columns(s))
        case Property.INDEPENDENT_OF_VELOCITY:
            holds = _same(columns(replace(s, velocity_rad_s=3.0 + v**2)), columns(s))
        case Property.PERIODIC_IN_MOTOR_ANGLE:
            has_a_say = not _same(columns(replace(s, motor_position_rad=angle + 0.3)), columns(s))
            holds = has_a_say and _same(
                columns(replace(s, motor_position_rad=angle + 2.0 * np.pi)), columns(s)
            )
        case Property.ODD_IN_CURRENT:
            holds = _is_odd(
                columns, s, replace(s, motor_torque_nm=-s.motor_torque_nm, current_a=-s.current_a)
            )
        case Property.ODD_IN_LOAD:
            turned = replace(
                s, load_torque_nm=-s.load_torque_nm, geared_torque_nm=-s.geared_torque_nm
            )
            holds = _is_odd(columns, s, turned)
        case Property.RATE_OF_TORQUE:
            holds = _is_zero_where(columns, s, replace(s, motor_torque_nm=_held(s.motor_torque_nm)))
        case Property.RATE_OF_LOAD:
            holds = _is_zero_where(columns, s, replace(s, load_torque_nm=_held(s.load_torque_nm)))
        case Property.SMOOTH:
            # A uniform cubic spline's slope is less than one an interval, and no variable here is
            # more than a hundred times its range; a change by a small part of itself turns no sign.
            change = columns(_scaled(s, 1.0 + 1e-8)) - columns(s)
            holds = (
                bool(np.any(change)) and float(np.max(np.abs(change))) <= 1e-8 * 100.0 * INTERVALS
            )
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
    of_geometry = {effect.declares for effect in chain.from_iterable(GEOMETRY)}
    assert of_geometry == {Property.TURNS_THE_ARM}


@pytest.mark.parametrize("effect", MEMBERS)
def test_columns_are_as_many_as_coefficients_and_belong_to_their_axes(effect: Effect) -> None:
    signals = random_signals(5)
    strange = random_signals(6)
    columns = effect.columns(signals, 0)
    joints = {
        GearSide.TWO_JOINTS: (2,),
        GearSide.ALL_JOINTS: (JOINTS,),
        GearSide.ALL_MOTORS: (JOINTS,),
    }.get(effect.side, ())
    expected = (*joints, len(effect.coefficients), SAMPLES)
    assert columns.shape == expected
    assert np.all(np.isfinite(columns))
    constant = np.array(
        [
            column.name == "preload" and effect.name == "passive-spring"
            for column in effect.coefficients
        ]
    )
    columns_range = np.ptp(columns, axis=-1)
    moving = columns_range > 0
    if effect.name == "cable":  # each stiffness of one joint alone acts on that joint
        moving = moving.any(axis=0)
    assert np.all(moving | constant)

    def changed(axes: list[int]) -> Signals:
        arrays = {}
        for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2", "motor_position_rad", "load_torque_nm",  # noqa: E501
                     "geared_torque_nm", "motor_torque_nm", "current_a"):  # fmt: skip
            array = getattr(signals, name).copy()
            array[axes] = getattr(strange, name)[axes]
            arrays[name] = array
        return replace(signals, **arrays)

    if effect.settings.get("other_axis"):
        other_axis = int(effect.settings["other_axis"])
        own = [0, other_axis - 1]
    else:
        own = [0]
    if effect.side is GearSide.ALL_MOTORS:
        own = list(range(JOINTS))
    assert np.array_equal(
        effect.columns(changed([axis for axis in range(JOINTS) if axis not in own]), 0), columns
    )
    # What depends on the clock alone is the same on all axes.
    is_by_time = effect.abscissa in {Abscissa.TIME, Abscissa.SESSION}
    of_the_clock = is_by_time and effect.declares in {
        Property.SMOOTH,
        Property.INDEPENDENT_OF_VELOCITY,
    }
    if not of_the_clock or effect.settings.get("signed"):
        assert not np.allclose(effect.columns(changed(own), 0), columns)


def test_columns_act_where_the_effect_says() -> None:
    ratio = np.diag([30.0, 40.0, 50.0])
    ratio[2, 1] = 25.0
    train = DriveTrain(ratio)
    rng = np.random.default_rng(1)
    one = rng.normal(size=(2, 7))
    two = rng.normal(size=(2, 2, 7))
    all_ = rng.normal(size=(3, 1, 7))
    at_joint = at_joints(Cogging(1), 2, one, train)
    # Motor 3 turns with joints 2 and 3, the second at half the ratio.
    assert at_joint == pytest.approx(np.stack((0.0 * one, 0.5 * one, one)))
    assert at_joints(Spring(), 1, one, train) == pytest.approx(
        np.stack((0.0 * one, one, 0.0 * one))
    )
    coupling = Coupling(3, 1)
    assert at_joints(coupling, 0, two, train) == pytest.approx(
        np.stack((two[0], 0.0 * one, two[1]))
    )
    assert np.array_equal(at_joints(Elasticity(), 1, all_, train), all_)
    of_motors = np.stack((all_[0], all_[1] + 0.5 * all_[2], all_[2]))
    assert at_joints(TimeSkew(), 0, all_, train) == pytest.approx(of_motors)


def test_a_pair_is_named_by_its_lower_axis_and_only_angles_have_a_sine() -> None:
    three = robot_from_urdf(THREE_AXES.urdf)
    gantry = robot_from_urdf(GANTRY.urdf)
    placed = [axis for axis in range(3) if is_placeable(Coupling(3, 1), axis, three)]
    assert placed == [0, 1]
    coupling = Coupling(4, 1)
    assert not is_placeable(coupling, 0, three)
    assert is_placeable(Spring(), 2, three)
    # What all motors share is tried once.
    assert [axis for axis in range(3) if is_placeable(TimeSkew(), axis, three)] == [0]
    assert is_placeable(PositionFriction(), 0, three)
    assert not is_placeable(PositionFriction(), 0, gantry)
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
        return np.asarray(signals.velocity_rad_s[axis] ** 3)[None]


def _duplicates(families: tuple[tuple[Effect, ...], ...]) -> list[tuple[str, str]]:
    """Pairs of effects of which one's columns span the other's on the robot's joints:
    they cannot be distinguished.
    """
    grid = np.linspace(30.0, 50.0, JOINTS)
    ratio = np.diag(grid)
    train = DriveTrain(ratio)
    first_run = random_signals(5)
    rest = random_signals(6)
    session_s = 300.0 + rest.time_s
    runs = (first_run, replace(rest, session_s=session_s))
    spans: list[tuple[str, FloatArray, bool]] = []
    for effect in chain.from_iterable(families):
        torque_of_runs = [at_joints(effect, 0, effect.columns(run, 0), train) for run in runs]
        torque = np.concatenate(torque_of_runs, axis=-1)
        # joint, parameter, sample → parameter, joint and sample
        columns = np.moveaxis(torque, 1, 0).reshape(torque.shape[1], -1)
        directions = np.linalg.svd(columns, full_matrices=False)[2]
        settings = ", ".join(f"{value:g}" for value in effect.settings.values())
        spans.append((f"{effect.name} ({settings})", directions, effect.with_motor))
    pairs = []
    for (one, first, driven), (other, second, other_driven) in combinations(spans, 2):
        if driven != other_driven:  # never on the same joint
            continue
        smallest = np.linalg.svd(first @ second.T, compute_uv=False)[-1]
        if smallest > 1.0 - 1e-9:
            pairs.append((one, other))
    return pairs


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
    difference = np.arange(300) - start
    time_s = difference / rate_hz
    ramp = np.maximum(time_s, 0.0)
    rate = np.where(time_s > 0.0, -np.expm1(-time_s / filter_s), 0.0)
    if backwards:
        ramp = ramp[::-1]
        rate = -rate[::-1]
    effect = Lag(filter_s, backwards)
    signals = replace(random_signals(1), rate_hz=rate_hz)
    motor_torque_nm = np.stack((ramp, np.full(300, 7.0)))
    found = effect.columns(replace(signals, motor_torque_nm=motor_torque_nm), 0)
    assert found[0] == pytest.approx(-rate, abs=1e-9)
    changed_signal = replace(signals, motor_torque_nm=np.full((1, 300), 7.0))
    assert effect.columns(changed_signal, 0) == pytest.approx(0.0, abs=1e-9)


def test_with_no_filter_it_is_the_central_difference() -> None:
    signals = random_signals(1)
    motor_torque_nm_gradient = np.gradient(signals.motor_torque_nm[2])
    slope = motor_torque_nm_gradient * signals.rate_hz
    assert Lag().columns(signals, 2)[0] == pytest.approx(-slope)
    assert TimeSkew().columns(signals, 0)[2, 0] == pytest.approx(-slope)


@pytest.mark.parametrize(
    "effect",
    [LoadFriction(0, 0.4, 1), LoadFriction(1, 0.4, 1), Efficiency(0.5, 0.4, 1)],
    ids=lambda one: one.name,
)
def test_the_rest_of_a_rotor_is_the_derivative_of_a_loss(effect: LoadFriction | Efficiency) -> None:
    s = random_signals(3)
    axis = 2
    step = 1e-7
    loss, rest = effect.columns(s, axis)
    rotor_inertia_kg_m2 = 0.4 - step
    (before,) = replace(effect, rotor_inertia_kg_m2=rotor_inertia_kg_m2, with_rotor=0).columns(
        s, axis
    )
    step_rotor_inertia_kg_m2 = 0.4 + step
    (after,) = replace(effect, rotor_inertia_kg_m2=step_rotor_inertia_kg_m2, with_rotor=0).columns(
        s, axis
    )
    np.testing.assert_allclose(rest, (after - before) / (2.0 * step), atol=1e-6)
    load_torque_nm = s.load_torque_nm - 0.4 * s.acceleration_rad_s2
    bare = replace(s, load_torque_nm=load_torque_nm)
    geared_torque_nm = s.geared_torque_nm - 0.4 * s.acceleration_rad_s2
    geared = replace(bare, geared_torque_nm=geared_torque_nm)
    changed_effect = replace(effect, rotor_inertia_kg_m2=0.0, with_rotor=0)
    (expected,) = changed_effect.columns(geared, axis)
    np.testing.assert_allclose(loss, expected, atol=1e-12)


def test_effects_behind_the_gear_leave_a_known_rotor_out() -> None:
    s = random_signals(4)
    axis = 2
    load_friction = LoadFriction(0, 0.3, 1)
    loss = PlacedEffect(load_friction, axis)
    effects = (PlacedEffect(Elasticity(), 1), loss)
    known = beside_rotors(s, effects)
    turning_nm = 0.3 * s.acceleration_rad_s2[axis]
    np.testing.assert_allclose(known.link_torque(axis), s.load_torque_nm[axis] - turning_nm)
    np.testing.assert_allclose(known.gear_torque(axis), s.geared_torque_nm[axis] - turning_nm)
    np.testing.assert_allclose(
        known.variable(Abscissa.LOAD, axis), s.load_torque_nm[axis] - turning_nm
    )
    np.testing.assert_allclose(known.link_torque(1), s.load_torque_nm[1])
    own = np.arange(JOINTS)[:, None] == axis
    np.testing.assert_allclose(
        known.inertia(slice(None), axis), s.inertia(slice(None), axis) - 0.3 * own
    )
    np.testing.assert_allclose(known.inertia(axis, axis), s.inertia(axis, axis) - 0.3)
    np.testing.assert_array_equal(known.inertia(slice(None), 1), s.inertia(slice(None), 1))
    np.testing.assert_array_equal(loss.effect.columns(known, axis), loss.effect.columns(s, axis))
    assert not np.allclose(Elasticity().columns(known, axis), Elasticity().columns(s, axis))
    placed_effect = PlacedEffect(LoadFriction(0), axis)
    assert beside_rotors(s, (placed_effect,)) is s


def test_an_inertial_coupling_against_its_variable_is_a_straight_line() -> None:
    """A picture of it against the velocity would be a cloud."""
    signals = random_signals(7)
    coupling = InertialCoupling(4)
    on_both_nm = coupling.columns(signals, 1)
    on_own_joint_nm = on_both_nm[0, 0]
    along = signals.variable(coupling.abscissa, 1, other=3)
    assert np.array_equal(on_own_joint_nm, along)
