"""Service, timer and crontab line: what is in them, that systemd takes them,
and that nothing foreign is replaced.
"""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.errors import ExitCode
from daq.jobs.units import Installation, cron_line, unit_name, units_of
from tests.daq.command_line import run_verb
from tests.daq.jobs.rig import Rig, make_rig

NAME = "drivegain-recalibrate-demo"


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    folder = tmp_path / "a cell"
    plan_file = tmp_path / "plan.yaml"
    return make_rig(folder, plan_file, max_duration_min=30)


def installation(rig: Rig, *, user: bool = False, schedule: str = "weekly") -> Installation:
    return Installation(rig.cell_file, Path("/usr/bin/true"), schedule, user, "root")


def read(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(text)
    return parser


def test_the_timer_never_makes_up_for_a_date_and_the_service_bounds_the_job(rig: Rig) -> None:
    section = rig.cell.recalibration
    assert section is not None
    units = units_of(rig.cell, section, installation(rig))
    service, timer = (read(unit.text) for unit in units)
    assert timer["Timer"]["Persistent"] == "false"
    assert timer["Timer"]["OnCalendar"] == "weekly"
    assert service["Service"]["Type"] == "oneshot"
    assert service["Service"]["Restart"] == "no"
    assert service["Service"]["KillSignal"] == "SIGTERM"
    timeoutstartsec = float(service["Service"]["TimeoutStartSec"])
    assert timeoutstartsec > 30 * 60
    expected = str(ExitCode.PROPOSED.value)
    assert service["Service"]["SuccessExitStatus"] == expected
    assert "AF_CAN" in service["Service"]["RestrictAddressFamilies"]
    assert "PrivateTmp" not in service["Service"]
    first_unit = units_of(rig.cell, section, installation(rig, user=True))[0]
    text = first_unit.text
    assert "User" not in read(text)["Service"]


def test_what_is_written_through_a_link_is_writable_to_the_service(
    rig: Rig, tmp_path: Path
) -> None:
    """ProtectHome= would lock the folder in which the file is, wherever the link to it is."""
    elsewhere = tmp_path / "controllers of all cells"
    elsewhere.mkdir()
    rig.controller.rename(elsewhere / "demo.yaml")
    rig.controller.symlink_to(elsewhere / "demo.yaml")
    section = rig.cell.recalibration
    assert section is not None
    units = units_of(rig.cell, section, installation(rig))
    service = units[0].text
    assert f'ReadWritePaths="-{elsewhere}"' in service.splitlines()


@pytest.mark.parametrize("owner", ["robot", "root"])
def test_the_service_is_little_exposed(rig: Rig, tmp_path: Path, owner: str) -> None:
    """A service of root keeps what it needs to replace another user's file and to lose no frame."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    section = rig.cell.recalibration
    assert section is not None
    service, _ = units_of(rig.cell, section, replace(installation(rig), owner=owner))
    (tmp_path / service.name).write_text(service.text, encoding="utf-8")
    command = [
        "systemd-analyze",
        "security",
        "--offline=yes",
        "--no-pager",
        str(tmp_path / service.name),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"exposure level for \S+: ([0-9.]+)", done.stdout)
    if found is None:
        pytest.skip(f"systemd-analyze cannot judge a file here: {done.stderr.strip()}")
    assert float(found[1]) <= 3.0, done.stdout
    # In place of CAP_SYS_NICE, for the capture's real-time priority
    assert "\nLimitRTPRIO=1\n" in service.text


@pytest.mark.parametrize("user", [False, True], ids=["system", "user"])
def test_systemd_takes_them(rig: Rig, tmp_path: Path, user: bool) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    section = rig.cell.recalibration
    assert section is not None
    units = units_of(rig.cell, section, installation(rig, user=user, schedule="Sun *-*-* 03:00:00"))
    for unit in units:
        (tmp_path / unit.name).write_text(unit.text, encoding="utf-8")
    command = ["systemd-analyze", *(["--user"] if user else []), "--man=no", "verify"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    done = subprocess.run(
        [*command, *(str(tmp_path / unit.name) for unit in units)],
        capture_output=True,
        text=True,
        check=False,
        env=env,
    )
    said = done.stdout + done.stderr
    if "Failed to initialize manager" in said:
        pytest.skip(f"systemd-analyze cannot verify here: {said.strip()}")
    # It also reads what else is installed on this machine.
    ours = [line for line in said.splitlines() if NAME in line]
    assert ours == [], said
    assert done.returncode == 0, said


def test_a_dry_run_shows_and_yes_writes_and_nothing_foreign_is_replaced(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "units"
    command = ["schedule", "--cell", str(rig.cell_file), "--to", str(folder)]
    assert main(command) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "Dry run" in shown
    assert "ExecStart=" in shown
    assert not folder.exists()
    assert run_verb(*command, "--yes") == ExitCode.OK
    shown = capsys.readouterr().out
    assert f"systemctl enable --now {NAME}.timer" in shown
    changed_shown = shown.replace("'", "")
    assert (f"systemctl link '{folder}/{NAME}.service' '{folder}/{NAME}.timer'").replace(
        "'", ""
    ) in changed_shown
    expected = [f"{NAME}.service", f"{NAME}.timer"]
    names = sorted(path.name for path in folder.iterdir())
    assert names == expected
    assert run_verb(*command, "--yes", "--schedule", "daily") == ExitCode.OK
    text = (folder / f"{NAME}.timer").read_text()
    assert "OnCalendar=daily" in text
    (folder / f"{NAME}.timer").write_text("[Timer]\nOnCalendar=yearly\n")
    before = (folder / f"{NAME}.service").read_bytes()
    assert run_verb(*command, "--yes") == ExitCode.USAGE
    assert "did not write" in capsys.readouterr().err
    assert (folder / f"{NAME}.timer").read_text() == "[Timer]\nOnCalendar=yearly\n"
    content = (folder / f"{NAME}.service").read_bytes()
    assert content == before


def test_a_unit_of_an_earlier_version_is_replaced(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "units"
    # Under its earlier name, with the first line that earlier versions wrote.
    command = ["install-units", "--cell", str(rig.cell_file), "--to", str(folder), "--yes"]
    assert main(command) == ExitCode.OK
    service = folder / f"{NAME}.service"
    now = service.read_text(encoding="utf-8")
    assert now.startswith("# Made by `drivegain schedule`, which may replace this file.\n")
    changed_now = now.replace("`drivegain schedule`", "`drivegain install-units`", 1)
    assert changed_now.count(" recalibrate ") == 1
    changed_now = changed_now.replace(" recalibrate ", " recalibrate --cell ")
    service.write_text(changed_now, encoding="utf-8")
    assert main(command) == ExitCode.OK
    assert service.read_text(encoding="utf-8") == now


def test_cron_gets_a_line(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb("schedule", "--cell", rig.cell_file, "--cron") == ExitCode.OK
    line = capsys.readouterr().out
    assert line.startswith("0 0 * * 1  ")
    assert line.rstrip().endswith(f"recalibrate '{rig.cell_file}'")
    assert line.count("\n") == 1
    code = run_verb("schedule", "--cell", rig.cell_file, "--cron", "--schedule", "Sun 03:00")
    assert code == ExitCode.USAGE


@pytest.mark.parametrize(
    ("word", "minute", "hour", "day_of_month", "day_of_week"),
    [
        # Dates of systemd.time(7): *-*-* *:00, *-*-* 00:00, Mon *-*-* 00:00 and *-*-01 00:00.
        ("hourly", "0", "*", "*", "*"),
        ("daily", "0", "0", "*", "*"),
        ("weekly", "0", "0", "*", "1"),
        ("monthly", "0", "0", "1", "*"),
    ],
)
def test_a_word_means_the_same_date_for_cron_and_for_systemd(
    rig: Rig, word: str, minute: str, hour: str, day_of_month: str, day_of_week: str
) -> None:
    wanted = installation(rig, schedule=word)
    fields = cron_line(wanted).split()[:5]
    expected = [minute, hour, day_of_month, "*", day_of_week]
    assert fields == expected


def test_names_and_paths_cannot_say_more_than_they_are(rig: Rig) -> None:
    section = rig.cell.recalibration
    assert section is not None
    named = replace(rig.cell, name='50 %h "cell"\nExecStart=/bin/false')
    wanted = replace(installation(rig), cell_file=Path("/cells/100 % $HOME/it's.yaml"))
    assert unit_name(named) == "drivegain-recalibrate-50-h-cell-execstart-bin-false-cc6ad2"
    expected = f"drivegain-recalibrate-{rig.cell.name}"
    assert unit_name(rig.cell) == expected
    others = {
        unit_name(replace(rig.cell, name=name))
        for name in ("Пресс 4", "Робот 4", "press 4", "press-4")
    }
    assert len(others) == 4
    text = units_of(named, section, wanted)[0].text
    service = read(text)["Service"]
    expected = '/usr/bin/true recalibrate "/cells/100 %% $$HOME/it\'s.yaml"'
    assert service["ExecStart"] == expected
    first_unit = units_of(named, section, wanted)[0]
    assert first_unit.text.count("\nExecStart=") == 1
    assert cron_line(wanted).endswith("recalibrate '/cells/100 \\% $HOME/it'\"'\"'s.yaml'")


def test_the_command_of_a_unit_has_options_of_the_help_alone(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_verb("recalibrate", "--help") == ExitCode.OK
    shown = capsys.readouterr().out
    section = rig.cell.recalibration
    assert section is not None
    service = read(units_of(rig.cell, section, installation(rig))[0].text)["Service"]
    for command in (service["ExecStart"], cron_line(installation(rig))):
        assert " recalibrate " in command
        for option in re.findall(r" (--?[a-z-]+)", command):
            assert option in shown


def test_the_unit_of_another_cell_and_a_pipe_are_left_alone(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "units"
    command = ["schedule", "--to", str(folder), "--yes", "--cell"]
    assert run_verb(*command, rig.cell_file) == ExitCode.OK
    other = rig.cell_file.with_name("another.yaml")
    shutil.copyfile(rig.cell_file, other)
    before = (folder / f"{NAME}.service").read_bytes()
    capsys.readouterr()
    assert run_verb(*command, other) == ExitCode.USAGE
    assert "the unit of another cell file" in capsys.readouterr().err
    content = (folder / f"{NAME}.service").read_bytes()
    assert content == before
    (folder / f"{NAME}.service").unlink()
    os.mkfifo(folder / f"{NAME}.service")
    assert run_verb(*command, rig.cell_file) == ExitCode.USAGE
    assert "did not write" in capsys.readouterr().err


@pytest.mark.parametrize("schedule", ["", "  ", "weekly\nPersistent=true"])
def test_a_schedule_that_no_line_can_say_is_refused(
    rig: Rig, tmp_path: Path, schedule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "schedule",
        "--cell",
        str(rig.cell_file),
        "--to",
        str(tmp_path / "units"),
        "--schedule",
        schedule,
    ]
    assert run_verb(*command, "--yes") == ExitCode.USAGE
    assert "--schedule" in capsys.readouterr().err
    assert not (tmp_path / "units").exists()


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not on this computer"
)
def test_systemd_reads_the_schedule_before_it_is_written(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run_verb("schedule", "--cell", rig.cell_file, "--schedule", "every sunday")
        == ExitCode.USAGE
    )
    assert "calendar" in capsys.readouterr().err
    assert run_verb("schedule", "--cell", rig.cell_file, "--schedule", "Sun 03:00") == ExitCode.OK
