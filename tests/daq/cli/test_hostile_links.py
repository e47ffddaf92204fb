"""Symbolic links in every path that a cell file names or implies: circles and other users' links, refused by name."""

from __future__ import annotations

import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationError, ExitCode
from daq.files import follow_links, replace_file
from daq.jobs.cell_fit import _check_replaceable
from daq.ledger.audit import AuditAction, append
from tests.daq.calibrations import calibration_for
from tests.daq.histories import RECALIBRATION

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
JOB = f"""
policy: {{motion: allowed}}{RECALIBRATION}  folder: sessions
  metrics: metrics
"""
CONFIGURED = ("demo.history.sqlite", "demo.audit.jsonl", "sessions", "metrics", "interlock")
REFUSED = {ExitCode.CALIBRATION_REFUSED, ExitCode.DATA_UNFIT, ExitCode.CONFIGURATION}


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """The demo cell with a job, in a folder of its own."""
    kept = shutil.ignore_patterns("*.jsonl", "*.sqlite*")
    shutil.copytree(Path(__file__).parents[3] / "configs", tmp_path / "configs", ignore=kept)
    path = tmp_path / "configs" / "cells" / "demo.yaml"
    path.write_text(path.read_text() + JOB)
    return path


def make_circle(path: Path) -> None:
    path.unlink(missing_ok=True)
    other = path.with_name(f"{path.name}-other")
    other.symlink_to(path)
    path.symlink_to(other)


@pytest.mark.parametrize("name", [*CONFIGURED, "../controllers/demo.yaml", "demo.yaml", "calibration-1.yaml"])
def test_links_in_a_circle_are_refused_by_every_verb(cell: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = calibration_for(cell)
    make_circle(Path(os.path.normpath(cell.parent / name)))
    file, fitted = str(cell), str(calibration)
    verbs = [["apply", file, fitted, "--yes"], ["rollback", file], ["history", file, "--verify"]]
    verbs += [["recalibrate", file, "--dry-run"], ["install-units", file], ["validate", fitted, "no.mcap"]]
    if name in CONFIGURED:
        verbs += [["history", file, "--rebuild"], ["report", fitted, "--cell", file, "--out", str(cell.parent / "out")]]
    for verb in verbs[:-1] if name == "demo.yaml" else verbs:
        code, said = main(verb), capsys.readouterr().err
        if "calibration" in name and verb[0] in ("rollback", "history", "recalibrate", "install-units"):
            continue
        assert code in REFUSED, (verb, code, said)
        assert Path(name).name in said or verb[0] == "validate", (verb, said)


def test_an_output_in_a_circle_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out.yaml"
    make_circle(out)
    with pytest.raises(OSError, match="circle"):
        replace_file(out, b"x")
    assert out.is_symlink()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
@pytest.mark.parametrize("name", CONFIGURED)
def test_the_link_of_another_user_is_followed_nowhere(cell: Path, tmp_path: Path, name: str) -> None:
    link, target = cell.parent / name, tmp_path / "elsewhere"
    target.touch()
    link.symlink_to(target)
    assert load_cell(cell).name == "demo"
    os.lchown(link, 4711, 4711)
    with pytest.raises(ConfigurationError, match="user 4711 has made"):
        load_cell(cell)
    os.chown(target, 4711, 4711)  # the link's maker may write the file
    assert load_cell(cell).name == "demo"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_no_entry_goes_through_another_users_link(tmp_path: Path) -> None:
    """`rollback --to FILE --audit AUDIT` names an audit log that no cell file has judged."""
    link, target = tmp_path / "audit.jsonl", tmp_path / "elsewhere"
    target.touch()
    link.symlink_to(target)
    append(link, AuditAction.PROPOSED, at=NOW, who="K.", subject="x", details={})
    written = target.read_bytes()
    os.lchown(link, 4711, 4711)
    with pytest.raises(OSError, match="user 4711 has made"):
        append(link, AuditAction.PROPOSED, at=NOW, who="K.", subject="x", details={})
    assert target.read_bytes() == written


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_a_fleet_does_not_replace_what_another_users_link_leads_to(tmp_path: Path) -> None:
    link, target = tmp_path / "demo.json", tmp_path / "elsewhere"
    target.touch()
    link.symlink_to(target)
    _check_replaceable(link)
    os.lchown(link, 4711, 4711)
    with pytest.raises(Exception, match="user 4711 has made"):
        _check_replaceable(link)
    with pytest.raises(OSError, match="user 4711 has made"):
        follow_links(link)
