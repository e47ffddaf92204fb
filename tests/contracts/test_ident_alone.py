"""`ident` needs numpy and scipy only: it imports, fits the documented example and searches it with
all else refused.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REFUSING = """
import sys
from importlib.abc import MetaPathFinder


class Refuse(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        top = name.partition(".")[0]
        allowed = {"ident", "lazy_names", "numpy", "scipy", *sys.stdlib_module_names}
        if top in allowed or (path is None and top.startswith("_")):
            return None
        raise ModuleNotFoundError(f"No module named {name!r}: refused by the test", name=name)


sys.meta_path.insert(0, Refuse())
"""
EXAMPLE = """
import runpy
import numpy as np

example = runpy.run_path(sys.argv[1])
found = example["main"]()
import ident

record = example["record"]
runs = [record(found.model, "bare", None, 1), record(found.model, "loaded", example["DISC"], 2)]
steps = ident.find_effects(ident.gather(found, runs), np.random.default_rng(0))
calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example["NAMEPLATE_NM_A"], steps=steps)
run = record(found.model, "unseen", example["DISC"], 9)
data = ident.differentiate(run, found.model.drive_train, found.conditioning)
print(ident.predict_current(calibration, found.model, data).shape)
for name in ident.__all__:
    getattr(ident, name)
"""  # noqa: E501


def _run(checkout: Path, code: str, also: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    gains_from_arrays_path = checkout / "examples" / "gains_from_arrays.py"
    return subprocess.run(
        [
            sys.executable,
            "-c",
            f"ALSO = {also}\n" + REFUSING + code,
            str(gains_from_arrays_path),
        ],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_example_fits_with_numpy_and_scipy_alone(checkout: Path) -> None:
    done = _run(checkout, EXAMPLE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("±") == 3
    last_line = done.stdout.splitlines()[-1]
    assert last_line == "(19998, 3)"


@pytest.mark.parametrize("package", ["yaml", "pydantic", "can", "daq"])
def test_what_is_refused_cannot_be_imported(checkout: Path, package: str) -> None:
    code = f"import {package}"
    refused = _run(checkout, code)
    assert refused.returncode == 1
    assert "refused by the test" in refused.stderr
