"""Symbolic links in every path that a verb writes to:
circles and other users' links, refused by name.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.cli.app import VERBS, main
from daq.cli.terminal import make_folder
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import save_calibration
from daq.errors import ConfigurationError, ExitCode, UsageError
from daq.files import follow_links, replace_file
from daq.jobs.cell_fit import _check_replaceable
from daq.ledger.audit import AuditAction, append
from daq.simulation.demo import MARK, make_room
from tests.daq.calibrations import calibration_for, demo_calibration
from tests.daq.cli.test_no_regular_file import WRITTEN, arguments
from tests.daq.histories import RECALIBRATION
from tests.daq.logs import demo_content, samples, write

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
JOB = f"""
policy: {{motion: allowed}}{RECALIBRATION}  folder: sessions
  metrics: metrics
"""
CONFIGURED = ("demo.history.sqlite", "demo.audit.jsonl", "sessions", "metrics", "interlock")
REFUSED = {ExitCode.CALIBRATION_REFUSED, ExitCode.DATA_UNFIT, ExitCode.CONFIGURATION}


@pytest.fixture
def cell_file(cell_file: Path) -> Path:
    """The demo cell with a job, in a folder of its own."""
    cell_file.write_text(cell_file.read_text() + JOB)
    return cell_file


def make_circle(path: Path) -> None:
    path.unlink(missing_ok=True)
    other = path.with_name(f"{path.name}-other")
    other.symlink_to(path)
    path.symlink_to(other)


@pytest.mark.parametrize(
    "name", [*CONFIGURED, "../controllers/demo.yaml", "demo.yaml", "calibration-1.yaml"]
)
def test_links_in_a_circle_are_refused_by_every_verb(
    cell_file: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = calibration_for(cell_file)
    path = Path(os.path.normpath(cell_file.parent / name))
    make_circle(path)
    file = str(cell_file)
    fitted = str(calibration)
    verbs = [["apply", file, fitted, "--yes"], ["rollback", file], ["history", file, "--verify"]]
    verbs += [
        ["recalibrate", file, "--dry-run"],
        ["schedule", file],
        ["validate", fitted, "no.mcap"],
    ]
    if name in CONFIGURED:
        out_folder = cell_file.parent / "out"
        verbs += [
            ["history", file, "--rebuild"],
            ["certificate", fitted, "--cell", file, "--out", str(out_folder)],
        ]
    for verb in verbs[:-1] if name == "demo.yaml" else verbs:
        code = main(verb)
        said = capsys.readouterr().err
        if "calibration" in name and verb[0] in ("rollback", "history", "recalibrate", "schedule"):
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
def test_the_link_of_another_user_is_followed_nowhere(
    cell_file: Path, tmp_path: Path, name: str
) -> None:
    link = cell_file.parent / name
    target = tmp_path / "elsewhere"
    target.touch()
    link.symlink_to(target)
    assert load_cell(cell_file).name == "demo"
    os.lchown(link, 4711, 4711)
    with pytest.raises(ConfigurationError, match="user 4711 has made"):
        load_cell(cell_file)
    os.chown(target, 4711, 4711)  # the link's maker may write the file
    assert load_cell(cell_file).name == "demo"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_no_entry_goes_through_another_users_link(tmp_path: Path) -> None:
    """`rollback --to FILE --audit AUDIT` names an audit log that no cell file has judged."""
    link = tmp_path / "audit.jsonl"
    target = tmp_path / "elsewhere"
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
    link = tmp_path / "demo.json"
    target = tmp_path / "elsewhere"
    target.touch()
    link.symlink_to(target)
    _check_replaceable(link)
    os.lchown(link, 4711, 4711)
    with pytest.raises(Exception, match="user 4711 has made"):
        _check_replaceable(link)
    with pytest.raises(OSError, match="user 4711 has made"):
        follow_links(link)


def _outputs() -> Iterator[tuple[str, list[str]]]:
    """Yield a name and the words of a command line for each place that a verb writes to,
    PIPE for that place.
    """
    # `console` only shows a folder's report.
    for verb in (verb for verb in VERBS if verb.name != "console"):
        for kind in verb.kinds or (verb,):
            if verb.kinds:
                words = [verb.name, kind.name]
            else:
                words = [verb.name]
            params = kind.command().params
            for one in params:
                annotation_text = str(one.type_descriptor.annotation)
                if "Path" in annotation_text and one.name in WRITTEN:
                    yield f"{' '.join(words)} {one.name}", [*words, *arguments(kind, params, one)]


OUTPUTS = dict(_outputs())


def _device(place: Path) -> None:
    try:
        os.mknod(place, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root may make a device")


def _link_of_another_user(place: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may give a link away")
    place.symlink_to(place.parent / "elsewhere")
    os.lchown(place, 4711, 4711)


@pytest.mark.parametrize("line", OUTPUTS)
@pytest.mark.parametrize(
    ("make", "found"),
    [
        (_link_of_another_user, "user 4711"),
        (os.mkfifo, "no regular file"),
        (_device, "no regular file"),
    ],
    ids=["link", "pipe", "device"],
)
def test_no_verb_writes_to_a_place_that_another_user_chose_nor_to_a_device(
    line: str,
    make: Callable[[Path], None],
    found: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = Path(__file__).parents[3] / "configs"
    place = tmp_path / "place.png"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.touch()
    make(place)
    calibration = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), calibration)
    before = place.lstat()
    demo_path = shipped / "cells" / "demo.yaml"
    files = {
        "PIPE": place,
        "configs/cells/demo.yaml": demo_path,
        "calibration.yaml": calibration,
    }
    assert main([str(files.get(word, word)) for word in OUTPUTS[line]]) not in (
        ExitCode.OK,
        ExitCode.UNEXPECTED,
    )
    error_output = capsys.readouterr().err
    assert found in " ".join(error_output.split())
    after = place.lstat()
    st_size = elsewhere.stat().st_size
    expected = (before.st_ino, before.st_mode, 0)
    assert (after.st_ino, after.st_mode, st_size) == expected


@pytest.mark.parametrize("line", [line for line in OUTPUTS if not line.endswith(" to")])
def test_no_verb_writes_a_file_of_the_name_of_standard_output(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main(["-" if word == "PIPE" else word for word in OUTPUTS[line]])
    assert code == ExitCode.USAGE
    assert "the name by which other programs mean standard output" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_nothing_is_written_through_a_link_that_comes_later(tmp_path: Path) -> None:
    """Between the command line and the write, and in the folders that it names."""
    link = tmp_path / "report.html"
    target = tmp_path / "elsewhere"
    target.write_bytes(b"mine")
    link.symlink_to(target)
    replace_file(link, b"mine, new")
    os.lchown(link, 4711, 4711)
    with pytest.raises(OSError, match="user 4711 has made"):
        replace_file(link, b"theirs")
    assert target.read_bytes() == b"mine, new"


def test_a_link_into_a_folder_that_everybody_may_write_is_followed_for_an_own_file_in_a_sticky_one(
    tmp_path: Path,
) -> None:
    link = tmp_path / "out.yaml"
    folder = tmp_path / "open"
    folder.mkdir()
    link.symlink_to(folder / "gains.yaml")
    (folder / "gains.yaml").touch()
    folder.chmod(0o777)
    with pytest.raises(OSError, match="everybody may write"):
        replace_file(link, b"x")
    folder.chmod(0o1777)
    replace_file(link, b"x")
    (folder / "gains.yaml").unlink()
    with pytest.raises(OSError, match="everybody may write"):
        replace_file(link, b"x")
    assert list(folder.iterdir()) == []


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="no regular file"):
        replace_file(tmp_path / "pipe", b"x")
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_a_demonstration_follows_no_link_in_a_folder_that_another_user_made(tmp_path: Path) -> None:
    mark = tmp_path / MARK
    target = tmp_path / "elsewhere"
    target.write_bytes(b"mine")
    mark.symlink_to(target)
    os.lchown(mark, 4711, 4711)
    with pytest.raises(OSError, match="user 4711 has made"):
        make_room(tmp_path, ())
    assert target.read_bytes() == b"mine"


def test_a_log_does_not_begin_under_the_name_of_a_link_that_leads_nowhere(
    tmp_path: Path, checkout: Path
) -> None:
    """Its last step, the rename, would find the name taken."""
    (tmp_path / "a.mcap").symlink_to(tmp_path / "gone.mcap")
    path = tmp_path / "a.mcap"
    with pytest.raises(UsageError, match=r"found a link .* to .*gone.mcap, where nothing is"):
        write(path, demo_content(checkout), samples([[0] * 6] * 5))
    assert not (tmp_path / "a.mcap.part").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["fit", "a.mcap", "--out"],
        ["residual", "a.mcap", "--report", "r", "--out"],
        ["plan", "demo.yaml", "--out"],
        ["export", "urdf", "demo.yaml", "c.yaml", "--out"],
        ["export", "mjcf", "demo.yaml", "c.yaml", "--out"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_link_into_a_folder_that_is_not_there_is_refused_before_any_work(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The work was done and lost: "free space or rights". The inputs here are not even there."""
    monkeypatch.chdir(tmp_path)
    link = tmp_path / "link"
    link.symlink_to("gone/there")
    assert main([*words, "link"]) == ExitCode.UNEXPECTED
    said = " ".join(capsys.readouterr().err.split())
    assert "found: a link of that name to gone/there, where nothing is" in said
    assert "create that folder" in said
    assert list(tmp_path.iterdir()) == [link]


@pytest.mark.parametrize("verb", ["fit", "residual"])
def test_pictures_under_the_name_of_a_link_to_nothing_are_refused_before_the_fit(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log is not even there."""
    link = tmp_path / "link"
    link.symlink_to("gone")
    log = str(tmp_path / "a.mcap")
    report = str(tmp_path / "report")
    words = [verb, log, "--report", report, "--pictures", str(link)]
    assert main(words) == ExitCode.USAGE
    assert "where nothing is" in capsys.readouterr().err


def test_a_plan_for_a_folder_that_is_not_there_is_refused_before_the_planning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The cell file is not even there."""
    cell = str(tmp_path / "demo.yaml")
    assert main(["plan", cell, "--out", str(tmp_path / "no" / "p.yaml")]) == ExitCode.UNEXPECTED
    assert "no such folder" in capsys.readouterr().err


def test_a_folder_of_pictures_that_is_a_link_to_nothing_is_called_that(tmp_path: Path) -> None:
    """It was "file exists … free space or rights"."""
    (tmp_path / "link").symlink_to("gone")
    with pytest.raises(UsageError, match="found a link of that name to gone, where nothing is"):
        make_folder(tmp_path / "link")
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="found a file of that name; expected a folder"):
        make_folder(tmp_path / "file")


@pytest.mark.parametrize(
    "words",
    [
        ["init", "file/below/x.yaml"],
        ["sign", "key", "--name", "anna", "--no-password", "--folder", "file/below"],
    ],
    ids=["init", "sign key"],
)
def test_an_output_below_a_file_is_refused_with_the_name_of_the_file(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It was "not a directory … free space or rights"."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "file"
    file.touch()
    assert main(words) != ExitCode.OK
    said = " ".join(capsys.readouterr().err.split())
    assert f"{file} is a file" in said
    assert "free space" not in said
    assert list(tmp_path.iterdir()) == [file]


#: Words of a verb before the name of its output
WRITING = {
    "certificate": ["certificate", "calibration.yaml", "--out"],
    "salvage": ["salvage", "a.mcap.part", "--out"],
    "export csv": ["export", "csv", "calibration.yaml", "a.mcap", "--out"],
    "export bag": ["export", "bag", "a.mcap", "--out"],
}


@pytest.mark.parametrize("words", WRITING.values(), ids=WRITING)
def test_an_output_that_is_a_folder_or_a_link_to_nothing_is_called_that(
    words: list[str],
    checkout: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Both were called files, and `export csv` replaced the link."""
    monkeypatch.chdir(tmp_path)
    save_calibration(demo_calibration(), tmp_path / "calibration.yaml")
    write(tmp_path / "a.mcap", demo_content(checkout), samples([[0] * 6] * 5))
    whole = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap.part").write_bytes(whole[:-100])
    suffixes = {"certificate": ".html", "salvage": ".mcap", "export csv": ".csv"}
    suffix = suffixes.get(" ".join(words[:2]), suffixes.get(words[0], ""))
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    link = tmp_path / f"link{suffix}"
    link.symlink_to("gone")
    before = sorted(tmp_path.rglob("*"))
    for out, words_of_it in (
        (folder, "a folder of that name"),
        (link, "a link of that name to gone, where nothing is"),
    ):
        assert main([*words, str(out)]) == ExitCode.USAGE
        said = " ".join(capsys.readouterr().err.split())
        assert words_of_it in said
    assert sorted(tmp_path.rglob("*")) == before
    assert link.is_symlink()
