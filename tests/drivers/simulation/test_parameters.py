"""Stored parameters of a simulated amplifier:
an entered gain is stored by 1010h and restored at power-on.
"""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from drivers.simulation.faults import FaultKind, FaultSpec
from tests.drivers.simulation.cells import clean_cell, running

GAIN = 0x2003
SAVE = int.from_bytes(b"save", "little")
NOT_IN_THIS_STATE = 0x08000022


def test_the_entered_gain_is_reported_in_both_objects(request: pytest.FixtureRequest) -> None:
    spec = clean_cell()
    changed_axis = replace(spec.axes[0], entered_gain_nm_per_a=-11.52)
    axes = (changed_axis, *spec.axes[1:])
    changed_spec = replace(spec, axes=axes)
    with running(changed_spec, request.node.name) as (_, master):
        assert master.read(1, GAIN, 1, "i") == -11520
        packed = struct.pack("<I", master.read(1, GAIN, 2, "I"))
        assert struct.unpack("<f", packed)[0] == pytest.approx(-11.52)
        # Not entered, and the cell does not reveal its true gain
        assert master.read(2, GAIN, 1, "i") == 0


def test_what_was_stored_comes_back_with_the_power(request: pytest.FixtureRequest) -> None:
    with running(clean_cell(), request.node.name) as (cell, master):
        assert master.write(3, GAIN, 1, "i", 24200) == 0
        saved = cell.nodes[2].saved.values
        assert saved[GAIN, 1] == 0
        assert master.write(3, 0x1010, 1, "I", SAVE) == 0
        assert cell.nodes[2].saved.values[GAIN, 1] == 24200
        assert master.write(3, GAIN, 1, "i", 7) == 0
        master.send(0x000, bytes([0x81, 3]))
        while master.receive()[0] != 0x703:
            pass
        assert master.read(3, GAIN, 1, "i") == 24200


def test_nothing_is_stored_while_the_motor_has_power(request: pytest.FixtureRequest) -> None:
    with running(clean_cell(), request.node.name) as (_, master):
        for controlword in (0x06, 0x07, 0x0F):
            assert master.write(2, 0x6040, 0, "H", controlword) == 0
        assert master.write(2, 0x1010, 1, "I", SAVE) == NOT_IN_THIS_STATE
        assert master.write(2, 0x6040, 0, "H", 0) == 0
        assert master.write(2, 0x1010, 1, "I", SAVE) == 0


@pytest.mark.parametrize(
    ("kind", "gain", "save"),
    [
        (FaultKind.REFUSES_WRITE, NOT_IN_THIS_STATE, 0),
        (FaultKind.REFUSES_SAVE, 0, NOT_IN_THIS_STATE),
    ],
)
def test_an_amplifier_may_refuse(
    request: pytest.FixtureRequest, kind: FaultKind, gain: int, save: int
) -> None:
    faults = (FaultSpec(kind, 1),)
    spec = replace(clean_cell(), faults=faults)
    with running(spec, request.node.name) as (_, master):
        assert master.write(2, GAIN, 1, "i", 5) == gain
        assert master.write(2, 0x1010, 1, "I", SAVE) == save
        assert master.write(1, GAIN, 1, "i", 5) == 0
        assert master.write(1, 0x1010, 1, "I", SAVE) == 0
