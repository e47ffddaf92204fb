"""The whole way: recorded from a simulated cell by the driver, identified, its effect named,
written back.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console, RenderableType

from daq.cli.app import main
from daq.config.cell import model_of
from daq.errors import ExitCode
from daq.log.conversion import load_run
from daq.report.job_schemas import DemoReport
from ident.errors import RolesExchanged
from ident.estimators.identify import identify
from ident.estimators.refusals import require_roles
from tests.pipeline.next_step import next_step


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One demonstration with short runs; the full length is `make demo`."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", "--out", str(out), "--duration", "10", "--seed", "2"]) == ExitCode.OK
    return out


def test_the_summary_reports_the_whole_story(demonstration: Path) -> None:
    summary = json.loads((demonstration / "summary.json").read_text())
    # The lists of its effects become tuples
    DemoReport.model_validate_json(json.dumps(summary), strict=False)
    assert [gain["axis"] for gain in summary["gains"]] == [f"J{number}" for number in range(1, 7)]
    # Runs of 10 s instead of 40 s: the bound of the full demonstration, 1.5 %, widened by less than
    # the root of that.
    for gain in summary["gains"]:
        assert abs(gain["error_percent"]) < 2.5
        assert gain["error_percent"] == pytest.approx(
            100 * (gain["identified"] / gain["truth"] - 1)
        )
    assert summary["effect"] == {"name": "load-friction", "axis": "J3"}
    assert len(summary["effects"]) == 1
    assert summary["error_after_percent"] < summary["error_before_percent"]
    assert summary["error_after_percent_axes"][2] < 0.7 * summary["error_before_percent_axes"][2]
    assert all(log["valid"] and log["lost_cycles"] == 0 for log in summary["logs"])
    assert summary["applied"]


def test_the_copy_of_the_controller_file_has_the_gains_and_every_comment(
    demonstration: Path, checkout: Path
) -> None:
    original = (checkout / "configs" / "controllers" / "demo.yaml").read_text()
    written = (demonstration / "controller.yaml").read_text()
    calibration = yaml.safe_load((demonstration / "calibration.yaml").read_text())
    drives = yaml.safe_load(written)["drives"]
    for gain in calibration["gains"]:
        assert drives[gain["axis"]]["gain"] == pytest.approx(gain["value"], rel=1e-4)
    assert [line.partition("#")[2] for line in written.splitlines()] == [
        line.partition("#")[2] for line in original.splitlines()
    ]


def test_the_certificate_says_that_the_gains_are_written(demonstration: Path) -> None:
    page = (demonstration / "report" / "report.html").read_text(encoding="utf-8")
    assert "✓ Written on " in page
    assert " by demo to controller.yaml: all 6 gains changed by more than noise" in page
    assert "What was written into out/controller.yaml" in page
    assert "Ready to be written" not in page
    assert "would be written" not in page
    # 32.96 was the previous gain.
    assert ">32.96<" in page


def test_the_pictures_are_there(demonstration: Path) -> None:
    files = chain(demonstration.glob("*.png"), demonstration.glob("*.svg"))
    pictures = {path.name for path in files}
    assert pictures == {"torques.svg", "gains.png", "residual-J3-load-friction.svg"}


def test_a_log_is_enough_to_identify_from(
    demonstration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = []
    for name in ("bare-1", "loaded-1", "bare-2", "loaded-2"):
        elsewhere.append(tmp_path / f"{name}.mcap")
        elsewhere[-1].write_bytes((demonstration / f"{name}.mcap").read_bytes())
    assert main(["fit", *map(str, elsewhere), "--json"]) == ExitCode.OK
    fitted = json.loads(capsys.readouterr().out)
    assert {
        "method",
        "gains",
        "parameters",
        "relative_error_percent",
        "condition",
        "rows",
        "filter",
        "effects",
    } <= set(fitted)
    assert set(fitted["gains"][0]) >= {
        "axis",
        "value",
        "std_percent",
        "unit",
        "nameplate",
        "change_percent",
    }
    assert set(fitted["parameters"][0]) >= {"name", "value", "unit", "std_percent"}
    assert len(fitted["relative_error_percent"]["axes"]) == 6
    assert fitted["method"] == "ml"
    assert len(fitted["compared"]["tls"]["gains"]) == 6


def test_loaded_logs_alone_are_refused(
    demonstration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(demonstration / "loaded-1.mcap")]) == ExitCode.DATA_UNFIT
    assert "without load too" in capsys.readouterr().err


def test_bare_logs_alone_are_refused(
    demonstration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(demonstration / "bare-1.mcap")]) == ExitCode.DATA_UNFIT
    assert "no run with a payload of known mass" in capsys.readouterr().err


def test_the_wrong_drive_train_shows_in_the_residual(
    demonstration: Path, tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Numerics pitfall: a coupling that the configuration forgets must not pass unseen."""
    text = (checkout / "configs" / "cells" / "demo.yaml").read_text()
    assert "[0, 0, 0, 0, 32, 32]" in text
    changed = text.replace("[0, 0, 0, 0, 32, 32]", "[0, 0, 0, 0, 0, 32]").replace(
        "../robots", f"{checkout}/configs/robots"
    )
    cell = tmp_path / "cell.yaml"
    cell.write_text(changed)
    logs = [
        str(demonstration / f"{name}.mcap") for name in ("bare-1", "loaded-1", "bare-2", "loaded-2")
    ]
    assert main(["fit", *logs, "--json"]) == ExitCode.OK
    right = json.loads(capsys.readouterr().out)["relative_error_percent"]["axes"]
    code = main(["fit", *logs, "--cell", str(cell), "--json"])
    streams = capsys.readouterr()
    if code == ExitCode.OK:
        wrong = json.loads(streams.out)["relative_error_percent"]["axes"]
        assert max(wrong[4], wrong[5]) > 2 * max(right[4], right[5])
    else:
        assert code == ExitCode.DATA_UNFIT


def test_exchanged_roles_turn_all_signs_and_are_named(demonstration: Path) -> None:
    (bare, cell), (loaded, _) = (
        load_run(demonstration / f"{name}.mcap") for name in ("bare-1", "loaded-1")
    )
    payload = loaded.payload
    exchanged = (replace(bare, payload=payload), replace(loaded, payload=None))
    with pytest.raises(RolesExchanged, match=r"dry friction.*fs1 = -.*exchanged"):
        identify(model_of(cell), exchanged, cell.conditioning)
    estimate = identify(model_of(cell), (bare, loaded), cell.conditioning).estimate
    nameplate = np.array([axis.nameplate_gain for axis in cell.axes])
    require_roles(estimate.gains, nameplate)
    with pytest.raises(RolesExchanged, match="exchanged"):
        require_roles(-estimate.gains, nameplate)


@pytest.mark.parametrize("columns", [80, 120])
def test_residual_prints_one_screen(
    demonstration: Path,
    searched: tuple[str, list[RenderableType]],
    columns: int,
) -> None:
    """Standard output and standard error together, as a terminal or a log shows them."""
    progress, parts = searched
    out = StringIO()
    console = Console(
        file=out, width=columns, soft_wrap=True, highlight=False, markup=False, force_terminal=True
    )
    for part in parts:
        console.print(part)
    lines = out.getvalue().splitlines() + progress.splitlines()
    assert len(lines) <= 40
    text = " ".join(out.getvalue().split())
    assert (
        "J3 has friction that grows with the load: the error of J3 on held-out runs falls from"
    ) in text
    assert "Drive gains with the effects" in text
    assert f"Written: {demonstration / 'again.yaml'}" in text
    assert next_step(progress.splitlines()[-1]) == "apply"


@pytest.fixture(scope="module")
def searched(demonstration: Path) -> tuple[str, list[RenderableType]]:
    """What `residual` says on standard error, and the parts of what it prints on standard
    output.
    """
    names = ("bare-1", "loaded-1", "bare-2", "loaded-2")
    logs = [str(demonstration / f"{name}.mcap") for name in names]
    out = demonstration / "again.yaml"
    said = StringIO()
    parts: list[RenderableType] = []

    def keep(view: Iterable[RenderableType], *written: Path | None) -> None:
        parts.extend(view)
        parts.extend(f"Written: {path}" for path in written if path is not None)

    with pytest.MonkeyPatch.context() as patch, redirect_stderr(said):
        patch.setattr("daq.cli.fit.print_view", keep)
        holdout = str(demonstration / "held-out.mcap")
        assert main(["residual", *logs, "--holdout", holdout, "--out", str(out)]) == ExitCode.OK
    return said.getvalue(), parts


def test_validate_measures_the_calibration_on_the_holdout_run(
    demonstration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = json.loads((demonstration / "summary.json").read_text())
    capsys.readouterr()
    calibration = demonstration / "calibration.yaml"
    held_out = demonstration / "held-out.mcap"
    assert main(["validate", str(calibration), str(held_out), "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert found["logs"][0]["relative_error_percent"]["total"] == pytest.approx(
        summary["error_after_percent"], rel=0.01
    )


def test_the_payload_of_the_holdout_run_is_weighed_and_nothing_touches_the_robot(
    demonstration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With runs of 10 s; with the 40 s of `make demo` the mass is within 0.5 % and the centre
    within 2 mm.
    """
    held_out = str(demonstration / "held-out.mcap")
    known = ["--calibration", str(demonstration / "calibration.yaml")]
    bare = ["--bare", str(demonstration / "bare-1.mcap")]
    assert main(["weigh", held_out, *known, *bare, "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert found["complete"]
    assert found["mass_kg"]["value"] == pytest.approx(
        4.59, abs=min(0.1, 3.0 * found["mass_kg"]["std"])
    )
    assert found["centre_m"]["value"] == pytest.approx([-0.06, -0.063, 0.095], abs=0.004)
    assert (
        main(
            ["contact", held_out, *known, "--quiet", str(demonstration / "loaded-1.mcap"), "--json"]
        )
        == ExitCode.OK
    )
    assert json.loads(capsys.readouterr().out)["contacts"] == []
