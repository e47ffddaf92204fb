"""A file in the place of another is called what it is, in one line,
by every reader of documents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from daq.config.cell_file import load_cell
from daq.config.drive import drive_from_text
from daq.config.import_description import load_import
from daq.config.yaml_file import (
    FORMATS,
    KEYS,
    DocumentKind,
    kind_of_file,
    kind_of_head,
    kind_of_tree,
    parse_yaml,
)
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.errors import DaqError
from daq.log.reader import read_log
from daq.simulation.simulation_file import load_scenario, load_simulation
from daq.workflow.plan import load_plan, plan, save_plan
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import demo_content, samples, write

CONFIGS = Path(__file__).parents[3] / "configs"


@dataclass(frozen=True)
class Files:
    """One file of each kind."""

    by_kind: dict[DocumentKind, Path]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Files:
    """Shipped ones, and those that the verbs write."""
    folder = tmp_path_factory.mktemp("kinds")
    cell = load_cell(CONFIGS / "cells/demo.yaml")
    save_plan(plan(cell, seed=1, duration_s=15.0, exchanges=0), folder / "plan.yaml")
    save_calibration(demo_calibration(), folder / "calibration.yaml")
    residual = '{"format": "drivegain-residual", "version": 1, "cell": "demo", "gains": []}'
    (folder / "residual.json").write_text(residual)
    record = '{"format": "drivegain drive record 1", "cell": "demo", "drives": []}'
    (folder / "record.json").write_text(record)
    path = folder / "run.mcap"
    write(path, demo_content(checkout), samples([[0] * 6] * 5))
    by_kind = {
        DocumentKind.CELL: CONFIGS / "cells/demo.yaml",
        DocumentKind.PLAN: folder / "plan.yaml",
        DocumentKind.CALIBRATION: folder / "calibration.yaml",
        DocumentKind.RESIDUAL: folder / "residual.json",
        DocumentKind.DRIVE_PROFILE: CONFIGS / "drives/generic-cia402.yaml",
        DocumentKind.DRIVE_RECORD: folder / "record.json",
        DocumentKind.IMPORT: CONFIGS / "imports/tx40.yaml",
        DocumentKind.SIMULATION: CONFIGS / "simulation/clean.yaml",
        DocumentKind.SCENARIO: CONFIGS / "simulation/faults-example.yaml",
        DocumentKind.LOG: folder / "run.mcap",
        DocumentKind.URDF: CONFIGS / "robots/tx40.urdf",
    }
    return Files(by_kind)


READERS: dict[DocumentKind, Callable[[Path], Any]] = {
    DocumentKind.CELL: load_cell,
    DocumentKind.PLAN: lambda path: load_plan(path, load_cell(CONFIGS / "cells/demo.yaml")),
    DocumentKind.CALIBRATION: load_calibration,
    DocumentKind.DRIVE_PROFILE: lambda path: drive_from_text(path.read_bytes(), path.name),
    DocumentKind.IMPORT: load_import,
    DocumentKind.SIMULATION: load_simulation,
    DocumentKind.SCENARIO: lambda path: load_scenario(path, 6, 1000),
    DocumentKind.LOG: read_log,
}


@pytest.mark.parametrize("kind", DocumentKind)
def test_every_kind_is_recognised(files: Files, kind: DocumentKind) -> None:
    assert kind_of_file(files.by_kind[kind]) is kind


@pytest.mark.parametrize("wanted", READERS)
@pytest.mark.parametrize("given", DocumentKind)
def test_a_file_in_the_place_of_another_is_called_what_it_is(
    files: Files, wanted: DocumentKind, given: DocumentKind
) -> None:
    path = files.by_kind[given]
    if given is wanted:
        READERS[wanted](path)
        return
    with pytest.raises(DaqError) as refused:
        READERS[wanted](path)
    assert refused.value.found == given.value
    assert "order of the command's help" in refused.value.remedy


def test_shipped_files_are_of_one_kind_each() -> None:
    """A kind that is recognised by keys must not take the files of another."""
    folders = {
        "cells": DocumentKind.CELL,
        "drives": DocumentKind.DRIVE_PROFILE,
        "imports": DocumentKind.IMPORT,
    }
    for folder, kind in folders.items():
        for path in (CONFIGS / folder).glob("*.yaml"):
            assert kind_of_file(path) is kind, path


def test_what_is_no_document_of_ours_has_no_kind(tmp_path: Path) -> None:
    found = set(KEYS) | set(FORMATS.values()) | {DocumentKind.LOG, DocumentKind.URDF}
    assert found == set(DocumentKind)
    assert kind_of_file(tmp_path) is None
    path = tmp_path / "missing.yaml"
    assert kind_of_file(path) is None
    for text in (
        b"drives: {J1: {gain: 1.0}}",
        b"- 1\n- 2",
        b"a: [",
        b"<html>",
        b"",
        b"format: [1]",
    ):
        (tmp_path / "file").write_bytes(text)
        file_folder = tmp_path / "file"
        assert kind_of_file(file_folder) is None
    assert (
        kind_of_head(b'\xef\xbb\xbf<?xml version="1.0"?>\n<robot name="arm">') is DocumentKind.URDF
    )
    tree = parse_yaml(b"format: drivegain-plan", "plan").tree
    assert kind_of_tree(tree) is DocumentKind.PLAN
