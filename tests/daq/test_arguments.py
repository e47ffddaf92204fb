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
    controller_file = Path("controller.yaml")
    target = daq.FileTarget(controller_file)
    cell_file = CHECKOUT / "configs/cells/demo.yaml"
    cell = daq.load_cell(cell_file)
    log = Path("run.mcap")
    logs = [Path("bare.mcap")]
    calibration_file = Path("calibration.yaml")
    fitted = _stand_in(daq.Fit)
    proposal = _stand_in(daq.Proposal)
    planned = _stand_in(Edit)
    request = daq.Request(CALIBRATION, NOW)
    of_fit = {
        "logs": logs,
        "holdout": logs,
        "cell": cell,
    }
    audit = Path("audit.jsonl")
    of_write = {
        "now": NOW,
        "audit": audit,
        "who": "Ada",
    }

    right: dict[str, dict[str, Any]] = {}
    right["load_cell"] = {"path": Path("cell.yaml")}
    right["load_run"] = {
        "path": log,
        "cell": cell,
        "lossy": daq.LossyLogs.REFUSED,
    }
    right["read_log"] = {"path": log}
    right["load_calibration"] = {
        "path": calibration_file,
        "own_effects": (),
    }
    right["save_calibration"] = {
        "calibration": CALIBRATION,
        "path": calibration_file,
    }
    right["fit_logs"] = {
        **of_fit,
        "created": NOW,
        "own_effects": (),
    }
    right["fit"] = {**of_fit, "gains_fixed": False}
    right["close_loop"] = {"start": fitted, "seed": 0}
    right["calibration_of"] = {
        "fitted": fitted,
        "created": NOW,
    }
    right["validate"] = {
        "calibration": CALIBRATION,
        "logs": logs,
        "cell": cell,
    }
    right["propose"] = {
        "target": target,
        "request": request,
    }
    right["apply"] = {
        "proposal": proposal,
        **of_write,
    }
    right["rollback"] = {
        "target": target,
        **of_write,
        "planned": planned,
    }
    return right


RIGHT = _right_arguments()


def _call(function: str, **changes: Any) -> Any:
    """Call a public function with right arguments but these."""
    arguments = {**RIGHT[function], **changes}
    public = getattr(lax, function)
    return public(**arguments)


def _cases() -> list[tuple[str, str]]:
    found = []
    for function, arguments in RIGHT.items():
        for name in arguments:
            found.append((function, name))
    return found


CASES = _cases()
WITHOUT_ZONE = datetime(2026, 3, 1)
WRONG: tuple[Any, ...] = (
    3.5,
    -1,
    "words",
    b"words",
    object(),
    {"a": 1},
    ["x", 3],
    WITHOUT_ZONE,
)
TEXTS = {"path", "audit", "who"}  #: Arguments that a text is right for


def test_every_public_function_is_looked_at() -> None:
    public = {name: getattr(daq, name) for name in daq.__all__}
    functions = {name for name, value in public.items() if inspect.isfunction(value)}
    assert functions == set(RIGHT)
    for name, arguments in RIGHT.items():
        signature = inspect.signature(public[name])
        parameters = signature.parameters.values()
        needed = {one.name for one in parameters if one.default is one.empty}
        assert needed <= set(arguments), name


@pytest.mark.parametrize(("function", "name"), CASES, ids=[".".join(case) for case in CASES])
def test_an_argument_of_another_type_is_refused_by_name(
    function: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for value in WRONG:
        is_text = isinstance(value, str)
        if is_text and name in TEXTS:
            continue
        # What an effect lacks is said by `EffectRefused`.
        is_list = isinstance(value, list)
        if is_list and name == "own_effects":
            continue
        with pytest.raises(daq.UsageError) as caught:
            _call(function, **{name: value})
        error = caught.value
        assert error.subject == f"{name} of {function}"
        type_name = type(value).__name__
        assert f"of type {type_name}" in error.found
        assert error.expected
    files = list(tmp_path.iterdir())
    assert files == []


@pytest.mark.parametrize(
    "function", ["load_cell", "load_run", "read_log", "load_calibration", "save_calibration"]
)
def test_a_folder_or_no_name_in_the_place_of_a_file_is_refused(
    function: str, tmp_path: Path
) -> None:
    with pytest.raises(daq.DaqError, match=str(tmp_path)):
        _call(function, path=tmp_path)
    with pytest.raises(daq.UsageError, match="expected the path of a file"):
        _call(function, path="")


@pytest.mark.parametrize("function", ["fit", "fit_logs", "validate"])
def test_one_log_in_the_place_of_a_list_is_named_with_the_list(function: str) -> None:
    for log in ("bare.mcap", Path("bare.mcap")):
        with pytest.raises(
            daq.UsageError,
            match=rf"logs of {function}: found .*give a list: \[bare, loaded\]",
        ):
            _call(function, logs=log)


def test_no_list_is_too_little_checked() -> None:
    with pytest.raises(
        daq.UsageError,
        match=r"holdout of fit_logs: .*expected a list of paths, each as Path or text",
    ):
        lax.fit_logs(["bare.mcap"], holdout=[3])
    fitted = RIGHT["close_loop"]["start"]
    with pytest.raises(
        daq.UsageError, match="seed of close_loop: found True of type bool; expected a whole number"
    ):
        lax.close_loop(fitted, True)


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
    request = daq.Request(calibration, now)
    with pytest.raises(daq.UsageError, match=words):
        lax.propose(target, request)


def _fields(kind: type) -> set[str]:
    """Names of the fields of a dataclass."""
    return {one.name for one in dataclasses.fields(kind)}


def _names(cases: tuple[tuple[str, Any, str], ...]) -> set[str]:
    """Names of the fields that cases have wrong."""
    return {name for name, _, _ in cases}


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
    target = RIGHT["propose"]["target"]
    with pytest.raises(daq.UsageError) as caught:
        daq.propose(target, request)
    assert caught.value.subject == f"{name} of the request"
    assert caught.value.expected == expected
    required = {"calibration", "now"}
    assert _names(OTHER_FIELDS) | required == _fields(daq.Request)


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
    assert _fields(kind) == right.keys()
    arguments = {**right, name: value}
    return kind(**arguments)


@pytest.mark.parametrize(("name", "value", "expected"), FILE_FIELDS)
def test_a_field_of_a_file_target_of_another_type_is_named(
    name: str, value: Any, expected: str, tmp_path: Path
) -> None:
    assert _names(FILE_FIELDS) == RIGHT_FILE.keys()
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
    assert _names(DRIVE_FIELDS) == right.keys()
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
    with pytest.raises(daq.UsageError) as by_proposal:
        daq.propose(target, request)
    with pytest.raises(daq.UsageError) as by_rollback:
        daq.rollback(target, NOW)
    for caught in (by_proposal, by_rollback):
        assert caught.value.subject == f"{name} of the {kind}"
        assert caught.value.expected == expected


def test_the_file_target_of_something_else_than_a_cell_is_refused() -> None:
    cell = RIGHT["fit"]["cell"]
    with pytest.raises(daq.UsageError) as of_text:
        lax.FileTarget.of("cell.yaml")
    assert of_text.value.subject == "cell of FileTarget.of"
    with pytest.raises(daq.UsageError) as of_number:
        lax.FileTarget.of(cell, 3)
    assert of_number.value.subject == "file of FileTarget.of"
    target = lax.FileTarget.of(cell, "other.yaml")
    assert target.file == Path("other.yaml")


def test_paths_may_be_texts(tmp_path: Path) -> None:
    file = str(tmp_path / "calibration.yaml")
    daq.save_calibration(CALIBRATION, file)
    loaded = daq.load_calibration(file)
    assert loaded.gains == CALIBRATION.gains
