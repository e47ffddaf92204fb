"""An effect of one's own goes the whole way, with the code of the documentation's page,
as module and as package.

The package is a folder on the path with its metadata, as an installation leaves it.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from daq.documents.calibration_file import load_calibration
from daq.errors import ExitCode
from ident.calibration import Calibration
from ident.errors import EffectNotInstalled

pytestmark = pytest.mark.slow

COSINE_NM = 3.0
SINE_NM = 1.5
SCREWS = 3

RECORDINGS = f"""
import sys
from dataclasses import replace

sys.path.insert(0, sys.argv[1])
import numpy as np

import ident
from gains_from_arrays import DISC, GEAR_RATIOS, NAMEPLATE_NM_A, TRUE_GAINS_NM_A, URDF, record

model = ident.Model(ident.robot_from_urdf(URDF), ident.DriveTrain(np.diag(GEAR_RATIOS)))
axes = ("J1", "J2", "J3")
nameplate = NAMEPLATE_NM_A


def planted(name, payload, seed):
    run = record(model, name, payload, seed)
    q = run.position_rad[:, 1]
    torque_nm = {COSINE_NM} * np.cos({SCREWS} * q) + {SINE_NM} * np.sin({SCREWS} * q)
    current_a = run.current_a.copy()
    current_a[:, 1] += np.sign(np.gradient(q)) * torque_nm / TRUE_GAINS_NM_A[1]
    return replace(run, current_a=current_a)


bare = planted("bare", None, 1)
loaded = planted("loaded", DISC, 2)
"""
"""Recordings of the example's arm with the effect on J2,
by a formula that is not the effect's own.
"""

USE = """
import json
from pathlib import Path

import daq

calibration = daq.load_calibration(Path("calibration.yaml"))
conditioning = ident.Conditioning()
unseen = planted("unseen", DISC, 9)
data = ident.differentiate(unseen, model.drive_train, conditioning)


def without_torque(calibration):
    (effect,) = calibration.effects
    nothing = tuple(replace(one, value=0.0) for one in effect.coefficients)
    return replace(calibration, effects=(replace(effect, coefficients=nothing),))


def left_a(calibration):
    rest_a = ident.predict_current(calibration, model, data) - data.current_a
    return float(np.sqrt(np.mean(rest_a[data.moving.all(axis=1), 1] ** 2)))


body = ident.weigh(calibration, model, [unseen], conditioning)
external = ident.external_torque(calibration, model, unseen, conditioning)
print(json.dumps({
    "with_a": left_a(calibration),
    "without_a": left_a(without_torque(calibration)),
    "mass_kg": body.mass_kg,
    "mass_std_kg": body.mass_std_kg,
    "external_nm": float(np.sqrt(np.mean(external.torque_nm[1] ** 2))),
}))
"""


def _blocks(checkout: Path, language: str) -> list[str]:
    """Code blocks of the page in one language."""
    page = (checkout / "docs" / "how-to" / "write-an-effect.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


class OtherPackage:
    """A folder with the page's module, which becomes an installed package,
    and programs that see it or not.
    """

    def __init__(self, checkout: Path, folder: Path) -> None:
        """Store the folders."""
        self.checkout = checkout
        self.site = folder / "site"
        self.work = folder / "work"

    def write_module(self) -> None:
        """Write the module alone: nothing registers its effects."""
        self.site.mkdir()
        self.work.mkdir(exist_ok=True)
        code, *_ = _blocks(self.checkout, "python")
        (self.site / "ring_effect.py").write_text(code, encoding="utf-8")

    def install(self) -> None:
        """Add the metadata that an installation makes of the page's `pyproject.toml`."""
        (toml,) = _blocks(self.checkout, "toml")
        project = tomllib.loads(toml)["project"]
        metadata = self.site / f"ring_effect-{project['version']}.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n",
            encoding="utf-8",
        )
        lines = ["[drivegain.effects]"]
        lines += [
            f"{name} = {value}"
            for name, value in project["entry-points"]["drivegain.effects"].items()
        ]
        (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def remove(self) -> None:
        """Remove module and metadata."""
        shutil.rmtree(self.site)

    def run(self, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Run Python in the work folder, with the package on its path."""
        path = os.pathsep.join((str(self.site), str(self.checkout)))
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=self.work,
            env={**os.environ, "PYTHONPATH": path, "COLUMNS": "400"},
            capture_output=True,
            text=True,
            check=False,
        )

    def run_code(self, code: str) -> subprocess.CompletedProcess[str]:
        """Run code behind the recordings."""
        return self.run(["-c", RECORDINGS + textwrap.dedent(code), str(self.checkout / "examples")])

    @property
    def calibration(self) -> Calibration:
        """The calibration that was written, read in this process,
        which does not have the package.
        """
        return load_calibration(self.work / "calibration.yaml")


@pytest.fixture
def other(checkout: Path, tmp_path: Path) -> OtherPackage:
    package = OtherPackage(checkout, tmp_path)
    package.write_module()
    return package


def _search(checkout: Path) -> str:
    """The page's second part: from recordings to a finding."""
    _, code = _blocks(checkout, "python")
    return code


def test_the_page_goes_from_an_equation_to_a_finding_in_few_lines(
    checkout: Path, other: OtherPackage
) -> None:
    code = "".join(_blocks(checkout, "python"))
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) <= 45
    done = other.run_code(_search(checkout))
    assert done.returncode == 0, done.stderr
    shown, message = _blocks(checkout, "text")
    number = r"\d+\.\d+"
    assert re.sub(number, "#", done.stdout) == re.sub(number, "#", shown)
    np.testing.assert_allclose(
        [float(one) for one in re.findall(number, done.stdout)],
        [float(one) for one in re.findall(number, shown)],
        atol=0.02,  # the last digits are the processor's
    )
    (effect,) = other.calibration.effects
    assert effect.package == "module ring_effect"
    missing = EffectNotInstalled("ring-friction", "J2", "ring-effect 1.2.0")
    assert " ".join(message.split()) == str(missing)


def test_an_effect_that_no_package_has_is_given_again(checkout: Path, other: OtherPackage) -> None:
    assert other.run_code(_search(checkout)).returncode == 0
    given = "import daq, json, ring_effect\nfrom pathlib import Path\n"
    given += 'c = daq.load_calibration(Path("calibration.yaml"), own_effects=ring_effect.EFFECTS)\n'
    given += "motion = ident.differentiate(bare, model.drive_train, ident.Conditioning())\n"
    given += "print(ident.predict_current(c, model, motion).shape)"
    assert other.run_code(given).stdout.startswith("(19998, 3)")
    not_given = given.replace(", own_effects=ring_effect.EFFECTS", "")
    refused = other.run_code(not_given)
    assert refused.returncode == 1
    assert "expected module ring_effect, which had it" in refused.stderr
    assert "give the effect to `load_calibration(path, own_effects=[...])`" in refused.stderr


def test_an_installed_effect_goes_the_whole_way_to_a_certificate_and_back(
    checkout: Path, other: OtherPackage
) -> None:
    other.install()
    code = _search(checkout)
    without_argument = code.replace(", own_effects=EFFECTS", "").replace(
        "from ring_effect import EFFECTS\n", ""
    )
    assert "ring_effect" not in without_argument
    searched = other.run_code(without_argument)
    assert searched.returncode == 0, searched.stderr

    (effect,) = other.calibration.effects
    assert (effect.name, effect.axis, effect.settings) == ("ring-friction", "J2", {"screws": 3.0})
    assert effect.package == "ring-effect 1.2.0"
    for coefficient, planted_nm in zip(effect.coefficients, (COSINE_NM, SINE_NM), strict=True):
        assert abs(coefficient.value - planted_nm) < 4.0 * coefficient.std
        assert coefficient.std < 0.05

    used = other.run_code(USE)
    assert used.returncode == 0, used.stderr
    measured = json.loads(used.stdout)
    assert measured["with_a"] < 0.08  # the noise of the recording is 0.05 A
    assert measured["without_a"] > 0.9 * COSINE_NM / 32.4 / 2**0.5
    assert abs(measured["mass_kg"] - 4.59) < 4.0 * measured["mass_std_kg"]
    assert measured["mass_std_kg"] < 0.1
    assert measured["external_nm"] < 1.0

    report = ["-m", "daq", "report", "calibration.yaml"]
    installed = other.run(report)
    assert installed.returncode == 0, installed.stderr
    page = (other.work / "calibration.html").read_text(encoding="utf-8")
    text = (
        r"J2 has friction of a slewing ring that its screws distort: amplitude 3\.3\d+ ± "
        r"[0-9.]+ Nm, screws 3\."
    )
    assert re.search(text, page)
    assert "is one of ring-effect 1.2.0" in page

    other.remove()
    refused = other.run_code(USE)
    assert refused.returncode == 1
    assert (
        "EffectNotInstalled: effect 'ring-friction' on J2: found no installed package that has it"
    ) in refused.stderr
    assert "expected ring-effect 1.2.0, which had it" in refused.stderr
    assert other.run(report).returncode == 0
    page = (other.work / "calibration.html").read_text(encoding="utf-8")
    assert "J2 has the effect 'ring-friction'" in page.replace("&#x27;", "'").replace("&#39;", "'")
    assert "is one of ring-effect 1.2.0" in page

    other.write_module()
    other.install()
    again = json.loads(other.run_code(USE).stdout)
    assert again == measured


CELL = """
name: three-axes
robot: {urdf: arm.urdf, gravity_m_s2: [0.0, 0.0, -9.81]}
drive_train: {ratio: [[40, 0, 0], [0, 50, 0], [0, 0, -45]]}
axes:
  - name: J1
    nameplate_gain_nm_per_a: 32.0
    limits: {position_deg: [-170, 170], velocity_deg_s: 600, acceleration_deg_s2: 3000}
  - name: J2
    nameplate_gain_nm_per_a: 34.0
    limits: {position_deg: [-170, 170], velocity_deg_s: 600, acceleration_deg_s2: 3000}
  - name: J3
    nameplate_gain_nm_per_a: -23.0
    limits: {position_deg: [-170, 170], velocity_deg_s: 600, acceleration_deg_s2: 3000}
payloads:
  - {name: disc, mounting: flange, mass_kg: 4.59}
"""
DESCRIPTION = """
name: NAME
cell: cell.yaml
position: {file: NAME.csv, columns: [q1, q2, q3], unit: rad, side: joint}
current: {file: NAME.csv, columns: [i1, i2, i3], unit: A}
rate_hz: 500.0
payload: PAYLOAD
"""
TABLES = """
for run in (bare, loaded, planted("unseen", DISC, 9)):
    table = np.hstack((run.position_rad, run.current_a))
    np.savetxt(f"{run.name}.csv", table, delimiter=",", header="q1,q2,q3,i1,i2,i3", comments="")
with open("arm.urdf", "w") as file:
    file.write(URDF)
"""


def _verb(other: OtherPackage, *arguments: str) -> str:
    """What a verb prints; it must succeed."""
    done = other.run(["-m", "daq", *arguments])
    assert done.returncode == 0, (arguments, done.stdout, done.stderr)
    return done.stdout


@pytest.mark.processes
def test_the_command_line_searches_validates_and_weighs_with_it(
    checkout: Path, other: OtherPackage
) -> None:
    other.install()
    assert other.run_code(TABLES).returncode == 0
    (other.work / "cell.yaml").write_text(CELL, encoding="utf-8")
    for name, payload in (("bare", "null"), ("loaded", "disc"), ("unseen", "disc")):
        text = DESCRIPTION.replace("NAME", name).replace("PAYLOAD", payload)
        (other.work / f"{name}.yaml").write_text(text, encoding="utf-8")
        _verb(other, "import", f"{name}.yaml", "--data", ".", "--out", f"{name}.mcap")
    found = _verb(
        other,
        "residual",
        "bare.mcap",
        "loaded.mcap",
        "--holdout",
        "unseen.mcap",
        "--out",
        "calibration.yaml",
        "--report",
        "report",
    )
    assert "J2 has friction of a slewing ring that its screws distort" in found
    (effect,) = other.calibration.effects
    assert effect.package == "ring-effect 1.2.0"
    assert effect.error_after_percent < 0.5 * effect.error_before_percent
    page = (other.work / "report" / "report.html").read_text(encoding="utf-8")
    assert "is one of ring-effect 1.2.0" in page
    _verb(other, "validate", "calibration.yaml", "unseen.mcap")
    weighed = json.loads(_verb(other, "weigh", "calibration.yaml", "unseen.mcap", "--json"))
    assert weighed["mass_kg"]["value"] == pytest.approx(4.59, abs=0.1)

    shutil.rmtree(other.site)
    for verb in ("validate", "weigh"):
        refused = other.run(["-m", "daq", verb, "calibration.yaml", "unseen.mcap"])
        assert refused.returncode == ExitCode.DATA_UNFIT
        text = " ".join(refused.stderr.split())
        assert "effect 'ring-friction' on J2" in text
        assert "expected ring-effect 1.2.0, which had it when the calibration was made" in text
        assert "install this package" in text
    _verb(other, "certificate", "calibration.yaml")
    assert ("is one of ring-effect 1.2.0") in (other.work / "calibration.html").read_text(
        encoding="utf-8"
    )


def test_a_cell_file_declares_it(checkout: Path, other: OtherPackage) -> None:
    other.install()
    declare = """
    from daq.config.effects import place_effect

    print(place_effect("ring-friction", 1, {"screws": 4}, model.robot))
    print(place_effect("ring-friction", 1, {"screws": 1}, model.robot))
    print(place_effect("rings", 1, {}, model.robot))
    """
    placed, out_of_range, unknown = other.run_code(declare).stdout.splitlines()
    assert placed == "PlacedEffect(effect=RingFriction(screws=4), axis=1)"
    assert "it lies between 2 and 24" in out_of_range
    assert "stribeck" in unknown
    assert "ring-friction" in unknown
