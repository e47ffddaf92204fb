"""Wrong arguments of the public functions:
one error of the service, which names the argument and what it takes.
"""

from __future__ import annotations

import dataclasses
import inspect
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

import daq
from daq.writeback.request import Edit
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import Saving
from tests.conftest import CHECKOUT
from tests.daq.calibrations import demo_calibration

lax: Any = daq  #: As a notebook sees it
CALIBRATION = demo_calibration()
NOW = datetime(2026, 3, 1, tzinfo=UTC)


def _stand_in(kind: type) -> Any:
    """An object of a class without content:
    a wrong argument is refused before the right ones are used.
    """
    return object.__new__(kind)


def _right_arguments() -> dict[str, dict[str, Any]]:
    """Arguments of the right type for each public function."""
    target = daq.FileTarget(Path("controller.yaml"))
    cell = daq.load_cell(CHECKOUT / "configs/cells/demo.yaml")
    logs = [Path("bare.mcap")]
    return {
        "load_cell": {"path": Path("cell.yaml")},
        "load_run": {"path": Path("run.mcap"), "cell": cell, "lossy": daq.LossyLogs.REFUSED},
        "read_log": {"path": Path("run.mcap")},
        "load_calibration": {"path": Path("calibration.yaml"), "own_effects": ()},
        "save_calibration": {"calibration": CALIBRATION, "path": Path("calibration.yaml")},
        "fit_logs": {
            "logs": logs,
            "holdout": logs,
            "cell": cell,
            "created": NOW,
            "own_effects": (),
        },
        "fit": {"logs": logs, "holdout": logs, "cell": cell, "gains_fixed": False},
        "close_loop": {"start": _stand_in(daq.Fit), "seed": 0},
        "calibration_of": {"fitted": _stand_in(daq.Fit), "created": NOW},
        "validate": {"calibration": CALIBRATION, "logs": logs, "cell": cell},
        "propose": {"target": target, "request": daq.Request(CALIBRATION, NOW)},
        "apply": {
            "proposal": _stand_in(daq.Proposal),
            "now": NOW,
            "audit": Path("audit.jsonl"),
            "who": "Ada",
        },
        "rollback": {
            "target": target,
            "now": NOW,
            "audit": Path("audit.jsonl"),
            "who": "Ada",
            "planned": _stand_in(Edit),
        },
    }


RIGHT = _right_arguments()


def _cases() -> list[tuple[str, str]]:
    found = []
    for function, arguments in RIGHT.items():
        found += [(function, name) for name in arguments]
    return found


CASES = _cases()
WRONG: tuple[Any, ...] = (
    3.5,
    -1,
    "words",
    b"words",
    object(),
    {"a": 1},
    ["x", 3],
    datetime(2026, 3, 1),
)
TEXTS = {"path", "audit", "who"}  #: Arguments that a text is right for


def test_every_public_function_is_looked_at() -> None:
    functions = {name for name in daq.__all__ if inspect.isfunction(getattr(daq, name))}
    assert functions == set(RIGHT)
    for name, arguments in RIGHT.items():
        parameters = inspect.signature(getattr(daq, name)).parameters.values()
        needed = {one.name for one in parameters if one.default is one.empty}
        assert needed <= set(arguments), name


@pytest.mark.parametrize(("function", "name"), CASES, ids=[".".join(case) for case in CASES])
def test_an_argument_of_another_type_is_refused_by_name(
    function: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for value in WRONG:
        if isinstance(value, str) and name in TEXTS:
            continue
        if isinstance(value, list) and name == "own_effects":
            continue  # what an effect lacks is said by `EffectRefused`
        with pytest.raises(daq.UsageError) as caught:
            getattr(lax, function)(**{**RIGHT[function], name: value})
        expected = f"{name} of {function}"
        assert caught.value.subject == expected
        assert f"of type {type(value).__name__}" in caught.value.found
        assert caught.value.expected
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "function", ["load_cell", "load_run", "read_log", "load_calibration", "save_calibration"]
)
def test_a_folder_or_no_name_in_the_place_of_a_file_is_refused(
    function: str, tmp_path: Path
) -> None:
    arguments = {**RIGHT[function], "path": tmp_path}
    with pytest.raises(daq.DaqError, match=str(tmp_path)):
        getattr(lax, function)(**arguments)
    with pytest.raises(daq.UsageError, match="expected the path of a file"):
        getattr(lax, function)(**{**arguments, "path": ""})


@pytest.mark.parametrize("function", ["fit", "fit_logs", "validate"])
def test_one_log_in_the_place_of_a_list_is_named_with_the_list(function: str) -> None:
    for log in ("bare.mcap", Path("bare.mcap")):
        with pytest.raises(
            daq.UsageError,
            match=rf"logs of {function}: found .*give a list: "
            r"\[bare, loaded\]",
        ):
            getattr(lax, function)(**{**RIGHT[function], "logs": log})


def test_no_list_is_too_little_checked() -> None:
    with pytest.raises(
        daq.UsageError,
        match=r"holdout of fit_logs: .*expected a list of paths, "
        r"each as Path or text",
    ):
        lax.fit_logs(["bare.mcap"], holdout=[3])
    with pytest.raises(
        daq.UsageError, match="seed of close_loop: found True of type bool; expected a whole number"
    ):
        lax.close_loop(RIGHT["close_loop"]["start"], True)


@pytest.mark.parametrize(
    ("calibration", "now", "words"),
    [
        (
            3.5,
            NOW,
            "calibration of the request: found 3.5 of type float; expected Calibration; "
            "write Request",
        ),
        (
            CALIBRATION,
            "today",
            "now of the request: found 'today' of type str; expected a datetime with its time zone",
        ),
    ],
)
def test_a_request_of_other_things_is_refused(calibration: Any, now: Any, words: str) -> None:
    target = RIGHT["propose"]["target"]
    with pytest.raises(daq.UsageError, match=words):
        lax.propose(target, daq.Request(calibration, now))


OTHER_FIELDS = (
    ("policy", 3.0, "ApplyPolicy, or None"),
    ("accepts_changed_configuration", "yes", "True or False"),
    ("entered_kg", [1.0], "a mapping from a name to a number"),
    ("entered_kg", {"disc": "12 kg"}, "a mapping from a name to a number"),
    ("base", 12, "a text, or None"),
    ("appliers", "Ada", "a list of texts"),
    ("file", "calibration.yaml", "a pathlib.Path, or None"),
    ("content", "text", "bytes, or None"),
)


@pytest.mark.parametrize(("name", "value", "expected"), OTHER_FIELDS)
def test_a_field_of_a_request_of_another_type_is_named(
    name: str, value: Any, expected: str
) -> None:
    request = daq.Request(CALIBRATION, NOW, **{name: value})
    with pytest.raises(daq.UsageError) as caught:
        daq.propose(RIGHT["propose"]["target"], request)
    assert caught.value.subject == f"{name} of the request"
    assert caught.value.expected == expected
    fields = {one.name for one in dataclasses.fields(daq.Request)}
    assert {name for name, *_ in OTHER_FIELDS} | {"calibration", "now"} == fields


FILE_FIELDS = (
    ("file", "controller.yaml", "a pathlib.Path"),
    ("keys", ["gain1"], "a mapping from a name to a text"),
    ("keys", {"J1": 3}, "a mapping from a name to a text"),
    ("format", "yaml", "ControllerFormat, or None"),
    ("factors", {"J1": "2"}, "a mapping from a name to a number"),
    ("cell", "demo", "Cell, or None"),
)
DRIVE_FIELDS = (
    ("cell", "demo", "Cell"),
    ("network", "can0", "CanopenNetwork"),
    ("saving", True, "Saving"),
)


def _target_with(kind: type, right: dict[str, Any], name: str, value: Any) -> Any:
    assert {one.name for one in dataclasses.fields(kind)} == right.keys()
    return kind(**{**right, name: value})


@pytest.mark.parametrize(("name", "value", "expected"), FILE_FIELDS)
def test_a_field_of_a_file_target_of_another_type_is_named(
    name: str, value: Any, expected: str, tmp_path: Path
) -> None:
    assert {name for name, *_ in FILE_FIELDS} == RIGHT_FILE.keys()
    target = _target_with(daq.FileTarget, RIGHT_FILE, name, value)
    _refuse(target, name, expected, "FileTarget")


@pytest.mark.parametrize(("name", "value", "expected"), DRIVE_FIELDS)
def test_a_field_of_a_drive_target_of_another_type_is_named(
    name: str, value: Any, expected: str
) -> None:
    cell = RIGHT["fit"]["cell"]
    right = {
        "cell": cell,
        "network": _stand_in(CanopenNetwork),
        "saving": Saving.KNOWN,
    }
    assert {name for name, *_ in DRIVE_FIELDS} == right.keys()
    target = _target_with(daq.DriveTarget, right, name, value)
    _refuse(target, name, expected, "DriveTarget")


RIGHT_FILE: dict[str, Any] = {
    "file": Path("controller.yaml"),
    "keys": {"J1": "gain1"},
    "format": None,
    "factors": {},
    "cell": None,
}


def _refuse(target: Any, name: str, expected: str, kind: str) -> None:
    """Neither a proposal nor a rollback takes the target."""
    request = daq.Request(CALIBRATION, NOW)
    for call in (lambda: daq.propose(target, request), lambda: daq.rollback(target, NOW)):
        with pytest.raises(daq.UsageError) as caught:
            call()
        assert caught.value.subject == f"{name} of the {kind}"
        assert caught.value.expected == expected


def test_the_file_target_of_something_else_than_a_cell_is_refused() -> None:
    cell = RIGHT["fit"]["cell"]
    for arguments, name in ((("cell.yaml",), "cell"), ((cell, 3), "file")):
        with pytest.raises(daq.UsageError) as caught:
            lax.FileTarget.of(*arguments)
        assert caught.value.subject == f"{name} of FileTarget.of"
    file = lax.FileTarget.of(cell, "other.yaml").file
    assert file == Path("other.yaml")


def test_paths_may_be_texts(tmp_path: Path) -> None:
    file = str(tmp_path / "calibration.yaml")
    daq.save_calibration(CALIBRATION, file)
    assert daq.load_calibration(file).gains == CALIBRATION.gains
