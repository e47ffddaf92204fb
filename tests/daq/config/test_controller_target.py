"""`controller` of a cell file: keys, units, formats, and objects of the drives."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.controller import Controller, ControllerFormat, GainObject
from daq.errors import ConfigurationError
from drivers.profiles.profile import DriveParameter, ParameterKind

CONFIGS = Path(__file__).parents[3] / "configs"
KEYS = "[a, {key: b, factor: 1000.0}, {key: c, factor: -1.0}, d, e, f]"
OBJECTS = "[" + ", ".join(["{index: 0x2003, subindex: 1, type: i32, factor: 1000.0}"] * 6) + "]"


def _cell(folder: Path, controller: str) -> Cell:
    demo_path = CONFIGS / "cells" / "demo.yaml"
    text = demo_path.read_text(encoding="utf-8").replace("../robots", str(CONFIGS / "robots"))
    (folder / "cell.yaml").write_text(
        text[: text.index("\ncontroller:")] + f"\ncontroller: {controller}\n"
    )
    return load_cell(folder / "cell.yaml")


def test_keys_may_have_a_factor_and_the_file_a_format(tmp_path: Path) -> None:
    controller = f"{{file: robot.cfg, format: xml, gains: {KEYS}}}"
    cell = _cell(tmp_path, controller)
    assert cell.controller is not None
    assert cell.controller.file == "robot.cfg"
    assert cell.controller.format == ControllerFormat.XML
    expected = ("a", "b", "c", "d", "e", "f")
    assert cell.controller.keys == expected
    assert cell.controller.factors == (1.0, 1000.0, -1.0, 1.0, 1.0, 1.0)
    assert cell.controller.objects == ()
    assert cell.controller_path == tmp_path / "robot.cfg"


def test_objects_alone_and_beside_a_file(tmp_path: Path) -> None:
    reported = GainObject(index=0x2003, subindex=1, type=ParameterKind.I32, factor=1000.0)
    controller = f"{{objects: {OBJECTS}}}"
    alone = _cell(tmp_path, controller)
    objects = (reported,) * 6
    assert alone.controller == Controller(objects=objects)
    assert alone.controller_path is None
    beside = _cell(tmp_path, f"{{file: robot.json, gains: [a, b, c, d, e, f], objects: {OBJECTS}}}")
    assert beside.controller is not None
    expected = ((reported,) * 6, "robot.json")
    assert (beside.controller.objects, beside.controller.file) == expected


@pytest.mark.parametrize(
    ("controller", "says"),
    [
        ("{file: a.yaml}", "file and gains of the controller, objects of the drives, or all three"),
        (f"{{gains: {KEYS}}}", "file and gains of the controller"),
        ("{}", "file and gains of the controller"),
        (f"{{format: xml, objects: {OBJECTS}}}", "format without file"),
        ("{file: a.yaml, gains: [a, b]}", "2 keys; expected 6, one for each axis"),
        (f"{{file: a.yaml, format: toml, gains: {KEYS}}}", "controller.format"),
        (
            "{file: a.yaml, gains: [a, b, c, d, e, {key: f, factor: 0.0}]}",
            "controller.gains[5].factor: found 0",
        ),
        ("{file: a.yaml, gains: [a, b, c, d, e, {key: f, unit: mNm}]}", "controller.gains[5].unit"),
        ("{file: a.yaml, gains: [a, b, c, d, e, {factor: 2.0}]}", "controller.gains[5].key"),
        ("{file: a.yaml, gains: [a, b, c, d, e, 7]}", "controller.gains[5]"),
        ("{objects: [{index: 0x2003, type: i32}]}", "1 objects; expected 6, one for each axis"),
        (f"{{objects: {OBJECTS.replace('1000.0', '0.0')}}}", "a factor that is not zero"),
        (f"{{objects: {OBJECTS.replace('i32', 'i8')}}}", "type"),
    ],
)
def test_what_fits_no_cell_is_refused_with_its_place(
    tmp_path: Path, controller: str, says: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        _cell(tmp_path, controller)
    assert says in str(caught.value)


def test_a_cell_without_a_bus_has_no_objects(tmp_path: Path) -> None:
    tx40_path = CONFIGS / "cells" / "tx40.yaml"
    text = tx40_path.read_text(encoding="utf-8").replace("../robots", str(CONFIGS / "robots"))
    (tmp_path / "cell.yaml").write_text(text + f"\ncontroller: {{objects: {OBJECTS}}}\n")
    with pytest.raises(ConfigurationError, match="objects of drives that no bus leads to"):
        load_cell(tmp_path / "cell.yaml")


@given(st.sampled_from(ParameterKind), st.floats(-5e9, 5e9))
def test_a_parameter_holds_the_nearest_number_or_refuses(kind: ParameterKind, value: float) -> None:
    parameter = DriveParameter(0x2003, 1, kind)
    lowest, highest = {
        ParameterKind.I16: (-(2**15), 2**15 - 1),
        ParameterKind.U16: (0, 2**16 - 1),
        ParameterKind.I32: (-(2**31), 2**31 - 1),
        ParameterKind.U32: (0, 2**32 - 1),
        ParameterKind.F32: (-5e9, 5e9),
    }[kind]
    if not lowest <= (value if kind is ParameterKind.F32 else round(value)) <= highest:
        with pytest.raises(ValueError, match="does not fit"):
            parameter.word(value)
        return
    word = parameter.word(value)
    assert 0 <= word < 1 << kind.bits
    held = parameter.value(word)
    if kind is ParameterKind.F32:
        packed = struct.pack("<f", value)
        assert packed == struct.pack("<I", word)
        difference = abs(held - value)
        limit = 6e-8 * abs(value) + 1e-45
        assert difference <= limit
    else:
        assert held == round(value)
    assert parameter.word(held) == word


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39])
def test_what_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"no number|does not fit"):
        DriveParameter(0x2003, 2, ParameterKind.F32).word(value)
