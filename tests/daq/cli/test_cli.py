"""The command line itself: help, exit codes, JSON, and the verbs init and info."""

from __future__ import annotations

import inspect
import io
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from daq.cli import main
from daq.cli.app import ALIASES, BY_JOB, VERBS
from daq.cli.terminal import say_written, show_steps
from daq.cli.verb import Job, Verb, cell_here, cells_in, continued
from daq.config.cell import PacingMode
from daq.config.cell_buses import load_warnings
from daq.config.cell_file import load_cell
from daq.config.import_description import load_import
from daq.documents.calibration_file import save_calibration
from daq.errors import ExitCode
from drivers.messages import CellEvent, EventKind
from tests.daq.calibrations import demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.logs import DISC, START_NS, demo_content, samples, write
from tests.pipeline.next_step import next_step


@pytest.mark.parametrize("verb", VERBS, ids=[verb.name for verb in VERBS])
def test_every_help_is_whole_and_ends_with_an_example_to_copy(
    verb: Verb, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    kinds = verb.kinds
    for command in ([verb.name], *([verb.name, kind.name] for kind in kinds)):
        assert run_verb(*command, "--help") == 0
        output = capsys.readouterr().out
        shown = next((kind for kind in kinds if kind.name == command[-1]), verb)
        assert shown.example.startswith("drivegain " + " ".join(command))
        copied = output.rpartition("Example:")[2].replace("\\\n", " ")
        changed_example = shown.example.replace("CELL", str(cell_here()))
        assert copied.split() == changed_example.split()
        # Nothing of a help text is taken for markup: units are in brackets.
        reported = _squeezed(output)
        assert max(map(len, output.splitlines())) <= 80
        parameters = inspect.signature(shown.function(), eval_str=True).parameters
        for parameter in parameters.values():
            (option,) = parameter.annotation.__metadata__
            assert _squeezed(option.help) in reported
            words = option.help.split()
            assert set(words) <= set(output.split())  # no word is cut


def test_the_list_shows_every_verb_with_its_whole_summary(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_verb("--help") == 0
    printed = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    for verb in VERBS:
        expected = f"{verb.name} {verb.summary}"
        assert expected in lines


@pytest.mark.parametrize(("earlier", "name"), ALIASES.items())
def test_an_earlier_name_is_the_same_verb_and_is_not_listed(
    earlier: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert name in {listed.name for listed in VERBS}
    assert run_verb(name, "--help") == 0
    shown = capsys.readouterr().out
    assert run_verb(earlier, "--help") == 0
    assert capsys.readouterr().out == shown
    assert f"`{earlier}`, goes on working" in _squeezed_lines(shown)
    assert run_verb("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    listed = {line.split()[0] for line in lines if line.startswith("  ")}
    assert name in listed
    assert earlier not in listed


def _squeezed_lines(text: str) -> str:
    return " ".join(text.split())


def test_every_job_of_the_help_has_its_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("-h") == 0
    sections = capsys.readouterr().out.split("\n\n")
    for job in Job:
        (section,) = (one for one in sections if one.startswith(f"{job.value}:"))
        lines = section.splitlines()[1:]
        named = [line.split()[0] for line in lines]
        expected = [verb.name for verb in BY_JOB[job]]
        assert named == expected


def test_an_example_chooses_none_of_several_cell_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be the first by name, and a copied `apply` would write to that one."""
    monkeypatch.chdir(tmp_path)
    for name in ("lathe", "saw"):
        assert run_verb("init", f"{name}") == 0
    assert len([*cells_in(Path())]) == 2
    assert cell_here() == Path("press-4/cells/press-4.yaml")


def test_an_example_uses_the_cell_file_of_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cell_here() == Path("press-4/cells/press-4.yaml")
    (example,) = [
        re.findall(r"init (\S+)", verb.example)[0] for verb in VERBS if verb.name == "init"
    ]
    assert run_verb("init", "other-cells/lathe") == 0
    assert run_verb("init", example) == 0
    assert cell_here().is_file()
    cells = cells_in(Path(), "press-4")
    assert [*cells] == [Path("press-4/cells/press-4.yaml")]
    lathe_folder = tmp_path / "other-cells" / "lathe"
    monkeypatch.chdir(lathe_folder)
    assert run_verb("scan", "-h") == 0
    lines = capsys.readouterr().out.splitlines()
    last_line = lines[-1]
    assert last_line.strip() == "drivegain scan cells/lathe.yaml"


def test_no_verb_waits_for_a_pipe_that_is_named_like_a_cell_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("cell.yaml")
    for words in (["scan", "--help"], ["export", "--help"]):
        assert main(words) == ExitCode.OK
        assert "Example:" in capsys.readouterr().out
    assert run_verb("scan", "missing.yaml") == ExitCode.CONFIGURATION


@pytest.mark.parametrize("verb", VERBS, ids=[verb.name for verb in VERBS])
def test_an_option_without_its_value_is_an_error_of_the_usual_form(
    verb: Verb, capsys: pytest.CaptureFixture[str]
) -> None:
    """For every option that takes one, as a person and as a program see it."""
    for one in verb.kinds or (verb,):
        names = [verb.name]
        parsed = verb.command()
        if verb.kinds:
            names.append(one.name)
            parsed = parsed.commands[one.name]
        options = [
            param
            for param in parsed.params
            if param.param_type_name == "option" and not param.is_flag
        ]
        takes_json = any("--json" in param.opts for param in parsed.params)
        for option in (max(param.opts, key=len) for param in options):
            assert main([*names, option]) == ExitCode.USAGE
            said = capsys.readouterr().err
            assert all(f"{label}:" in said for label in ("error", "found", "expected", "do"))
            assert option in said
            if takes_json:
                assert main([*names, "--json", option]) == ExitCode.USAGE
                failure = json.loads(capsys.readouterr().err)
                assert (failure["kind"], failure["exit_code"]) == ("UsageError", ExitCode.USAGE)
                assert option in failure["found"]
                expected = f"`drivegain {verb.name} --help` explains it"
                assert failure["do"] == expected


@pytest.mark.parametrize(
    ("words", "missing", "wanted"),
    [
        (["weigh"], "argument 'CALIBRATION'", "calibration.yaml written by `drivegain fit`"),
        (["import", "press-4.yaml"], "option '--out'", "Log to write (.mcap); must not exist"),
    ],
)
def test_what_is_missing_is_said_as_the_help_says_it(
    capsys: pytest.CaptureFixture[str], words: list[str], missing: str, wanted: str
) -> None:
    assert main(words) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert f"Missing {missing}" in said
    name = missing.split("'")[1]
    assert f"expected: {name} ({wanted})" in said


def test_a_value_of_the_wrong_type_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    record = ["record", "cell.yaml", "plan.yaml", "--out", "a.mcap", "--mass"]
    assert run_verb(*record, "4,59") == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "found:    '4,59': Invalid value for '--mass'" in said
    assert "do:       write a decimal point: 4.59" in said
    assert run_verb(*record, "heavy") == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "found:    'heavy': " in said
    assert "--help` explains it" in said


def test_a_calibration_is_no_log_but_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), file)
    assert run_verb("info", file) == ExitCode.DATA_UNFIT
    said = capsys.readouterr().err
    assert "found:    a calibration\n" in said
    assert f"do:       `drivegain certificate {file}` reads it" in said


def test_progress_in_a_pipe_is_a_whole_line_a_step(capsys: pytest.CaptureFixture[str]) -> None:
    title = "record loaded-1: " + "a long remark on this run " * 4
    with show_steps() as stepper:
        stepper.step(title)
        stepper.progress(3, 10, "moves")
        assert capsys.readouterr().err == ""
        stepper.step("identify")
        error_output = capsys.readouterr().err
        assert error_output == f"{title} (0 s)\n"
    assert capsys.readouterr().err == "identify (0 s)\n"


def test_examples_name_files_that_other_examples_make() -> None:
    examples = []
    for verb in VERBS:
        for kind in (verb, *verb.kinds):
            examples.append(kind.example)
    made = set()
    for one in examples:
        for value in re.findall(r"--(?:out|report) (\S+)", one):
            made.add(value)
    used = set()
    for one in examples:
        for word in one.split():
            if re.search(r"\.(mcap|yaml)$", word):
                used.add(word)
    # Made by `record` with other options, as in the guide, and by `init`.
    of_init = {"press-4/imports/press-4.yaml", "press-4/cells/press-4.yaml"}
    expected = {"unloaded.mcap", "held-out.mcap", *of_init}
    assert used - made == expected


@pytest.mark.parametrize("width", [40, 78])
def test_a_command_that_is_broken_into_lines_is_the_same_to_a_shell(width: int) -> None:
    command = (
        "drivegain record cells/a.yaml plan.yaml --out loaded.mcap --payload disc --mass "
        "4.59 --enable-motion"
    )
    lines = continued(command, width, indent="  ")
    assert max(map(len, lines)) <= width + 2
    found = shlex.split("\n".join(lines).replace("\\\n", " "))
    assert found == command.split()
    for line in lines:
        assert not line.endswith(("--out \\", "--mass \\"))


def test_the_table_of_exit_codes_is_that_of_the_code(checkout: Path) -> None:
    page = (checkout / "docs/reference/exit-codes.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d to]+) \|", page, re.MULTILINE)
    named: list[int] = []
    for row in rows:
        first, _, last = row.partition(" to ")
        named.extend(_span(first, last))
    sorted_codes = sorted(code.value for code in ExitCode)
    assert sorted(named) == sorted_codes
    for code in ExitCode:
        word = {ExitCode.OK: "ok"}.get(code, code.name.lower().replace("_", " ").split()[-1])
        assert word in page or code in range(10, 15)


def test_the_help_names_every_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("--help") == 0
    printed = capsys.readouterr().out
    said = " ".join(printed.split())
    listed = said[said.index("Exit codes:") :].replace("10 to 14", "10 11 12 13 14")
    matches = re.findall(r"\d+", listed)
    numbers = {int(number) for number in matches}
    expected = {code.value for code in ExitCode}
    assert numbers == expected


def _span(first: str, last: str) -> range:
    return range(int(first), int(last or first) + 1)


def test_a_unit_in_a_help_text_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("scan", "--help") == 0
    printed = capsys.readouterr().out
    assert "How long to wait for answers [s]." in " ".join(printed.split())


def test_a_misspelt_verb_is_put_right(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("recrod") == ExitCode.USAGE
    error_output = capsys.readouterr().err
    assert "Did you mean 'record'?" in " ".join(error_output.split())


@pytest.mark.parametrize("arguments", [["--help"], ["--version"]])
def test_light_work_brings_no_mathematics(checkout: Path, arguments: list[str]) -> None:
    heavy = ("matplotlib", "pinocchio", "numba", "scipy", "canopen")
    code = (
        f"import sys; import daq.cli.app; daq.cli.app.main({arguments!r});print([name for name in "
        f"{heavy!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=checkout, check=True
    )
    assert done.stderr == "[]\n"


def test_what_was_written_is_reported_line_by_line(tmp_path: Path) -> None:
    out = io.StringIO()
    (tmp_path / "[s] pictures").mkdir()
    console = Console(file=out, soft_wrap=True)
    say_written(console, None, Path("cali\x1b.yaml"), tmp_path / "[s] pictures")
    lines = out.getvalue().splitlines()
    expected = ["Written: cali\\x1b.yaml", f"Written: {tmp_path}/[s] pictures/"]
    assert lines == expected


def _squeezed(text: str) -> str:
    """Without white space: where a line is broken is no matter."""
    return "".join(text.split())


@pytest.mark.parametrize(
    ("arguments", "named", "expected"),
    [
        (["no-such-verb"], "no-such-verb", "Usage: drivegain"),
        (["info"], "'LOG'", r"LOG \("),
        (["info", "--no-such-option", "x"], "--no-such-option", "Usage: drivegain"),
        (["import", "x"], "'--out'", r"--out \("),
        (
            ["record", "a", "b", "--out", "c", "--mass", "heavy"],
            "'--mass'",
            "Usage: drivegain",
        ),
    ],
)
def test_wrong_usage_is_exit_code_2(
    arguments: list[str], named: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert re.search(rf"found: .*{named}.*\nexpected: {expected}.*\ndo: .*--help", output.err)
    assert run_verb(*arguments, "--json") == 2
    output = capsys.readouterr()
    assert output.out == ""
    document = json.loads(output.err)
    assert named in document["found"]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("--version") == 0
    assert capsys.readouterr().out.startswith("drivegain ")


@pytest.fixture
def log(checkout: Path, tmp_path: Path) -> Path:
    """A loaded run of the demo cell."""
    cell_event = CellEvent(START_NS, None, EventKind.MOVE_START, 1, "")
    events = (
        cell_event,
        CellEvent(START_NS, 2, EventKind.EMCY, 0x2310, "\x1b[2Jcurrent"),
    )
    path = tmp_path / "a.mcap"
    return write(
        path,
        demo_content(checkout, DISC),
        samples([[k] * 6 for k in range(500)]),
        events,
    )


def test_info_json_is_one_object_and_nothing_else(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_verb("info", log, "--json") == 0
    output = capsys.readouterr()
    assert output.err == ""
    found = json.loads(output.out)
    expected = ("loaded", {"m": 4.59})
    known = found["payload"]["known"]
    assert (found["role"], known) == expected
    assert found["samples"] == 500
    assert found["duration_s"] == 0.5
    assert found["rate_hz"] == 1000.0
    assert found["moves"] == 1
    assert found["lost_cycles"] == 0
    assert found["valid"] is True
    assert found["axes"] == ["J1", "J2", "J3", "J4", "J5", "J6"]
    codes = [event["code"] for event in found["events"]]
    assert codes == [0x2310]
    assert len(found["sha256"]) == len(found["cell_sha256"]) == 64


def test_info_as_text_cannot_command_the_terminal(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_verb("info", log) == 0
    text = capsys.readouterr().out
    assert "loaded" in text
    assert "\x1b" not in text
    assert "\\x1b[2Jcurrent" in text


def test_info_of_a_damaged_log_is_exit_code_4(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(data)
    assert run_verb("info", log, "--json") == 4
    output = capsys.readouterr()
    assert output.out == ""
    assert "checksum" in output.err


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_an_output_that_cannot_be_written_is_reported(
    log: Path, checkout: Path, more: list[str]
) -> None:
    command = [sys.executable, "-m", "daq", "info", str(log), *more]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=checkout, check=False
        )
    assert done.returncode == ExitCode.UNEXPECTED
    assert "no space left" in done.stderr
    assert not re.search("Traceback|Exception", done.stderr)


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_reader_that_has_seen_enough_is_no_error_to_report(
    log: Path, checkout: Path, more: list[str]
) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        command = [sys.executable, "-m", "daq", "info", str(log), *more]
        done = subprocess.run(
            command, stdout=writing, stderr=subprocess.PIPE, text=True, cwd=checkout, check=False
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (ExitCode.UNEXPECTED, "")


def test_init_makes_a_cell_that_can_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "press-4"
    assert run_verb("init", folder) == 0
    printed = capsys.readouterr()
    assert next_step(printed.err) == "scan"
    lines = printed.out.splitlines()
    written = {Path(line) for line in lines}
    expected = {path for path in folder.rglob("*") if path.is_file()}
    assert written == expected
    cell = load_cell(folder / "cells/press-4.yaml")
    assert cell.name == "press-4"
    assert [(bus.interface, bus.channel) for bus in cell.buses] == [("socketcan", "can0")]
    assert cell.controller_path == folder / "controllers/press-4.yaml"
    assert cell.controller_path.is_file()
    description = folder / "imports/press-4.yaml"
    found = (description.parent / load_import(description).cell).resolve()
    assert found == folder / "cells/press-4.yaml"
    for path in folder.rglob("*.yaml"):
        head = re.match(r"(#.*\n)+", path.read_text(encoding="utf-8"))
        assert head, path
        assert not re.search("simulated|TX-40|tx40", head[0])
        assert path.parent.name == "drives" or "press-4" in head[0]
    text = (folder / "cells/press-4.yaml").read_text(encoding="utf-8")
    (axis, *_) = yaml.safe_load(text)["axes"]
    explained = re.findall(r"^  #   (\w+) ", text, re.MULTILINE)
    assert explained == list(axis)
    names = [path.name for path in folder.parent.iterdir()]
    assert names == ["press-4"]


def test_init_for_the_simulated_cell_changes_bus_and_sampling_alone(tmp_path: Path) -> None:
    for folder, option in (("real", []), ("simulated", ["--simulated"])):
        press_4_folder = tmp_path / folder / "press-4"
        assert run_verb("init", press_4_folder, *option) == 0
    real, simulated = (
        tmp_path / folder / "press-4/cells/press-4.yaml" for folder in ("real", "simulated")
    )
    cell = load_cell(simulated)
    expected = [("socketcand", "can0", "127.0.0.1", 29536)]
    assert [(bus.interface, bus.channel, bus.host, bus.port) for bus in cell.buses] == expected
    assert cell.sync is not None
    assert cell.sync.pacing is PacingMode.LOCKSTEP
    one, other = (yaml.safe_load(path.read_text(encoding="utf-8")) for path in (real, simulated))
    assert {key for key in one if one[key] != other[key]} == {"bus", "sync"}


def test_the_bus_of_a_new_cell_has_room_for_the_start_of_a_move(tmp_path: Path) -> None:
    folder = tmp_path / "press-4"
    assert run_verb("init", folder) == 0
    cell = load_cell(folder / "cells/press-4.yaml")
    assert cell.sync is not None
    assert cell.sync.pacing is PacingMode.TIMED
    assert load_warnings(cell) == ()


def test_init_overwrites_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "press-4").mkdir()
    (tmp_path / "press-4/notes.txt").write_text("mine", encoding="utf-8")
    assert run_verb("init", tmp_path / "press-4") == 2
    assert "something in it" in capsys.readouterr().err
    files = (tmp_path / "press-4").iterdir()
    assert [path.name for path in files] == ["notes.txt"]


def test_init_into_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "press-4").mkdir()
    assert run_verb("init", tmp_path / "press-4") == 0
    assert run_verb("init", tmp_path / "press-4") == 2
    assert run_verb("init", tmp_path / "press 4;") == 2
