"""Full parameters with a prior: coverage of gains, base parameters and links,
and whether a wrong prior is noticed.

    python -m tests.studies.prior_study --cells 17

Simulated cells of four robots, each with motions and noise of its own: two runs of 20 s without
load and two with the weighed payload. Each is fitted once. Then each tolerance has priors drawn
around the plant's links by the distribution that the prior declares (`right`), and these with all
masses and inertias times 1.3 (`heavy`), 0.7 (`light`), or either of them, link by link (`mixed`).
Cells are kept in out/prior-study; a study that was interrupted goes on where it was. The real
TX-40, where DRIVEGAIN_DATA has it, is fitted with fixed gains and the prior of the cell's URDF.
Writes the tables of docs/evidence/prior.md if all cells are there.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.fit import declared_effects, with_effects_of_cell
from drivers.simulation.spec import CellSpec
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.model.bodies import Payload
from ident.model.model import JOINT_COLUMNS, Model
from ident.physical.full_parameters import FullParameters, LinkPrior, RestsOn, full_parameters
from ident.physical.physical import urdf_links
from tests.ident.physical.drawn_links import drawn_links
from tests.studies.direct_cell import MOVING, RawRun, run_of
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished, made_once
from tests.studies.followed_cell import follow, point_to_point
from tests.studies.loop_noise import NORMAL_95
from tests.studies.output import print_line
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.real_runs import data_folder, tx40

OUT = Path("out/prior-study")
TABLES = Path("docs/evidence/data")
CELLS = 17  #: Of each robot: 408 gains together
DURATION_S = 20.0
BETWEEN_S = 60.0  #: From the beginning of one run to that of the next
TOLERANCES = (0.05, 0.1, 0.2)
OFF = 0.3  #: How far the masses of a wrong prior are off
KINDS = ("right", "heavy", "light", "mixed")
LARGE_SHIFT = 0.3  #: σ of a gain


@dataclass(frozen=True, slots=True)
class PriorRobot:
    """A robot of the study."""

    name: str  #: in the tables
    cell: str  #: shipped cell file
    simulation: str  #: shipped simulation file


ROBOTS = (
    PriorRobot("TX-40", "demo", "clean"),
    PriorRobot("KR270", "kr270", "kr270"),
    PriorRobot("seven-axis", "seven-axis", "seven-axis"),
    PriorRobot("gantry", "gantry", "gantry"),
)


def kept_runs(robot: PriorRobot, seed: int, out: Path) -> tuple[Cell, CellSpec, list[Run]]:
    """Return a cell, its truth without load and its four runs,
    which are simulated unless they are there.
    """
    cells_folder = shipped_configurations() / "cells"
    cell = load_cell(cells_folder / f"{robot.cell}.yaml")
    spec = load_simulation(shipped_simulation(robot.simulation))
    path = out / f"{robot.name}-{seed}.npz"
    rooms = (*MOVING, "tests.studies.followed_cell")
    source = digest_of_source("tests.studies.followed_cell", rooms)
    fingerprint = digest(source, cell.digest, DURATION_S, spec.urdf, spec.axes, spec.effects)
    if not is_finished(path, fingerprint):
        out.mkdir(parents=True, exist_ok=True)
        write_runs(path, simulated_runs(robot, cell, seed))
        finish(path, fingerprint)
    body = cell.payloads[0]
    raw = read_runs(path, lambda name: Payload(name, body.mounting, {"m": body.mass_kg}))
    runs = [run_of(one, cell) for one in raw]
    return cell, spec, runs


def simulated_runs(robot: PriorRobot, cell: Cell, seed: int) -> list[RawRun]:
    """Simulate four runs, every other one with the cell's first payload."""
    body = cell.payloads[0]
    runs = []
    for number, mounted in enumerate((None, body.name, None, body.name)):
        path = shipped_simulation(robot.simulation)
        spec = replace(
            load_simulation(path, mounted),
            seed=1000 * seed + number,
        )
        rng = np.random.default_rng([seed, number])
        demand = point_to_point(cell, spec.start_rad, rng, DURATION_S)
        payload = None
        if mounted is not None:
            known = {"m": body.mass_kg}
            payload = Payload(body.name, body.mounting, known)
        began_s = BETWEEN_S * number
        runs.append(follow(cell, spec, demand, f"run-{number}", payload, began_s))
    return runs


def fitted(cell: Cell, runs: Sequence[Run]) -> Identification:
    """Fit runs by ``ml``, with the effects that the cell declares."""
    effects = declared_effects(cell)
    start = identify(
        model_of(cell),
        runs,
        cell.conditioning,
        method=Method.ML,
        keep_rows=bool(effects),
        judge=not effects,
    )
    steps = with_effects_of_cell(start, effects, cell.place_names)
    return steps[-1].after.identification if steps else start


def true_standard(spec: CellSpec, model: Model) -> FloatArray:
    """True standard parameters of a simulated serial cell, shape (c,):
    what motors turn acts on joints by r rᵀ.
    """
    index = {column.name: number for number, column in enumerate(model.columns)}
    standard = np.zeros(len(index))
    standard[model.link_columns] = urdf_links(spec.urdf)
    coupled = model.drive_train.coupled
    for number, axis in enumerate(spec.axes):
        joint = JOINT_COLUMNS * number
        standard[joint + 11] += axis.viscous_nm_s_rad
        standard[joint + 12] += axis.coulomb_nm
        standard[joint + 13] += axis.offset_nm
        for turned, share in enumerate(model.drive_train.direction[number]):
            standard[JOINT_COLUMNS * turned + 10] += share**2 * axis.motor_inertia_kg_m2
            standard[JOINT_COLUMNS * turned + 11] += share**2 * axis.motor_viscous_nm_s_rad
        if number in coupled:
            standard[index[f"Iam{number + 1}"]] = axis.motor_inertia_kg_m2
            standard[index[f"fvm{number + 1}"]] = axis.motor_viscous_nm_s_rad
            standard[index[f"fsm{number + 1}"]] = axis.motor_coulomb_nm
        else:
            standard[joint + 12] += axis.motor_coulomb_nm
    return standard


def priors(links: FloatArray, tolerance: float, rng: np.random.Generator) -> dict[str, LinkPrior]:
    """Return a right prior of true links, shape (n, 10), and wrong ones, by KINDS."""
    right = drawn_links(LinkPrior(links, tolerance), rng)
    even = np.ones((len(links), 1))
    either = rng.choice((1.0 - OFF, 1.0 + OFF), size=(len(links), 1))
    scales = {
        "right": even,
        "heavy": (1.0 + OFF) * even,
        "light": (1.0 - OFF) * even,
        "mixed": either,
    }
    return {kind: LinkPrior(scale * right, tolerance) for kind, scale in scales.items()}


def study(robot: PriorRobot, seed: int, out: Path) -> dict[str, Any]:
    """Return what one cell gives."""
    cell, spec, runs = kept_runs(robot, seed, out)
    found = fitted(cell, runs)
    estimate = found.estimate
    gain_nm_per_a = [axis.gain_nm_per_a for axis in spec.axes]
    gains = np.array(gain_nm_per_a)
    standard = true_standard(spec, found.model)
    base = found.system.base.grouping @ standard
    count = len(base)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    cases = []
    for tolerance in TOLERANCES:
        links = urdf_links(spec.urdf)
        for kind, prior in priors(links, tolerance, rng).items():
            full = full_parameters(found.system, estimate, prior)
            cases.append(
                {
                    "tolerance": tolerance,
                    "prior": kind,
                    **case(full, estimate, gains, base, standard),
                }
            )
    parameter_difference = estimate.parameters[:count] - base
    gain_difference = estimate.gains - gains
    return {
        "robot": robot.name,
        "seed": seed,
        "axes": list(cell.axis_names),
        "relative_error_percent": found.training_error.total,
        "z": (gain_difference / estimate.gains_std).tolist(),
        "std_percent": (100.0 * estimate.gains_std / np.abs(gains)).tolist(),
        "base_z": (parameter_difference / estimate.parameters_std[:count]).tolist(),
        "cases": cases,
    }


def case(
    full: FullParameters,
    estimate: Estimate,
    gains: FloatArray,
    base: FloatArray,
    standard: FloatArray,
) -> dict[str, Any]:
    """Figures of one prior of one cell, from the true gains, base and standard parameters."""
    # Rotors, friction and offsets have no prior of their own.
    of_link = np.isfinite(full.prior_std)
    by_data = np.array([basis is RestsOn.DATA for basis in full.basis])
    parameter_error = np.abs(full.standard - standard)
    inside = parameter_error < NORMAL_95 * full.standard_std
    check = full.check
    gain_difference = full.gains - estimate.gains
    smallest_eigenvalue = float(full.eigenvalues.min())
    base_difference = full.base - base
    return {
        "z": ((full.gains - gains) / full.gains_std).tolist(),
        "shift": (gain_difference / estimate.gains_std).tolist(),
        "std_ratio": (full.gains_std / estimate.gains_std).tolist(),
        "base_z": (base_difference / full.base_std).tolist(),
        "data": int(by_data.sum()),
        "parameters": len(by_data),
        "data_inside": inside[by_data].tolist(),
        "prior_inside": inside[of_link & ~by_data].tolist(),
        "least_eigenvalue": smallest_eigenvalue,
        "bounded": full.bounded,
        "chi_square": check.chi_square,
        "degrees_of_freedom": check.degrees_of_freedom,
        "link_z": ((check.link_ratios - 1.0) / check.link_ratio_stds).tolist(),
        "misfit": check.is_misfit,
        "mass_ratio": check.mass_ratio,
        "mass_ratio_std": check.mass_ratio_std,
        "noticed": check.is_wrong,
    }


def kept(robot: PriorRobot, seed: int, out: Path = OUT) -> dict[str, Any]:
    """Return the figures of a cell, which are made unless they are there."""
    modules = (
        "tests.studies.followed_cell",
        "ident.estimators.identify",
        "ident.physical.full_parameters",
    )
    sources = [digest_of_source(module) for module in modules]
    fingerprint = digest(robot, seed, DURATION_S, TOLERANCES, OFF, sources)
    return made_once(
        out, f"{robot.name}-{seed}", fingerprint, lambda _: study(robot, seed, out / "runs")
    )


def coverage(z: Sequence[Sequence[float]]) -> str:
    """Share of 95 % intervals that hold, with the standard error from cell to cell [%]."""
    shares = np.array([np.mean(np.abs(one) <= NORMAL_95) for one in z])
    weights = np.array([len(one) for one in z])
    share = float(np.average(shares, weights=weights))
    error = float(np.std(weights * (shares - share), ddof=1) / (weights.mean() * np.sqrt(len(z))))
    return f"{100.0 * share:.1f} ± {100.0 * error:.1f}"


def without_prior(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Row of the fit alone."""
    z = np.concatenate([one["z"] for one in cells])
    return [
        "none",
        "",
        str(len(z)),
        coverage([one["z"] for one in cells]),
        f"{np.sqrt(np.mean(z**2)):.2f}",
        coverage([one["base_z"] for one in cells]),
    ]


def of_prior(cells: Sequence[dict[str, Any]], tolerance: float) -> list[str]:
    """Row of the right priors of one tolerance."""
    cases = list(cases_of(cells, tolerance, "right"))
    z = np.concatenate([one["z"] for one in cases])
    shifts = [one["shift"] for one in cases]
    shift = np.abs(np.concatenate(shifts))
    before = np.concatenate([one["z"] for one in cells])
    stacked_shifts = np.concatenate([one["shift"] for one in cases])
    after = before + stacked_shifts
    by_data = np.concatenate([one["data_inside"] for one in cases])
    by_prior = np.concatenate([one["prior_inside"] for one in cases])
    return [
        f"{100.0 * tolerance:.0f} %",
        f"{sum(one['data'] for one in cases)} of {sum(one['parameters'] for one in cases)}",
        str(len(z)),
        coverage([one["z"] for one in cases]),
        f"{np.sqrt(np.mean(z**2)):.2f}",
        coverage([one["base_z"] for one in cases]),
        f"{100.0 * by_data.mean():.1f}",
        f"{100.0 * by_prior.mean():.1f}",
        f"{np.sqrt(np.mean(shift**2)):.2f}",
        f"{shift.max():.2f}",
        f"{100.0 * np.mean(shift > LARGE_SHIFT):.0f}",
        f"{np.sqrt(np.mean(after**2) / np.mean(before**2)):.2f}",
        f"{min(one['least_eigenvalue'] for one in cases):.2g}",
    ]


def cases_of(
    cells: Iterable[dict[str, Any]], tolerance: float, kind: str
) -> Iterable[dict[str, Any]]:
    """The cases of one tolerance and kind of prior."""
    for cell in cells:
        for one in cell["cases"]:
            if one["tolerance"] == tolerance and one["prior"] == kind:
                yield one


HEADINGS = (
    "prior's tolerance",
    "parameters from data",
    "gains",
    "coverage of gains %",
    "rms z of gains",
    "coverage of base parameters %",
    "of full ones from data %",
    "of links' from the prior %",
    "rms shift of gains σ",
    "largest shift σ",
    "shifted by more than 0.3 σ %",
    "rms error of gains by that of none",
    "least eigenvalue",
)


def noticed(cells: Sequence[dict[str, Any]]) -> list[list[str]]:
    """How often each kind of prior is called wrong, by robot and tolerance."""
    rows = []
    for robot in ROBOTS:
        mine = [one for one in cells if one["robot"] == robot.name]
        for tolerance in TOLERANCES:
            row = [robot.name, f"{100.0 * tolerance:.0f} %"]
            for kind in KINDS:
                cases = cases_of(mine, tolerance, kind)
                found = [one["noticed"] for one in cases]
                row.append(f"{sum(found)} of {len(found)}")
            rows.append(row)
    return rows


def by_gain(cells: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Every gain: its σ, its error without a prior,
    and its shift by the right prior of each tolerance.
    """
    rows = []
    for cell in cells:
        shifts = [
            next(iter(cases_of([cell], tolerance, "right")))["shift"] for tolerance in TOLERANCES
        ]
        for number, axis in enumerate(cell["axes"]):
            figures = [
                cell["std_percent"][number],
                cell["z"][number],
                *(shift[number] for shift in shifts),
            ]
            seed_text = str(cell["seed"])
            rows.append([cell["robot"], seed_text, axis, *(f"{figure:.3f}" for figure in figures)])
    return rows


def published_base(folder: Path) -> dict[str, tuple[float, float]]:
    """Published weighted values of the TX-40's base parameters and their σ, by name."""
    with (folder / "tx40" / "published_base_parameters.csv").open(encoding="utf-8") as stream:
        return {
            row[0]: (float(row[3]), 0.01 * float(row[4]) * abs(float(row[3])))
            for row in csv.reader(stream)
        }


def real_tx40(
    folder: Path, tolerance: float
) -> tuple[list[list[str]], list[list[str]], FullParameters]:
    """Full parameters of the real TX-40, and its base parameters beside the published ones,
    as rows.
    """
    recording = tx40(folder)
    cell = recording.cell
    found = identify(
        model_of(cell),
        recording.runs,
        cell.conditioning,
        method=Method.ML,
        fixed_gains=recording.gains,
    )
    links = urdf_links(cell.urdf)
    prior = LinkPrior(links, tolerance)
    full = full_parameters(found.system, found.estimate, prior)
    index = {name: number for number, name in enumerate(full.names)}
    given = np.full(len(index), np.nan)
    given[found.model.link_columns] = prior.links
    rows = []
    for name, number in index.items():
        if np.isnan(given[number]):
            said = ""
        else:
            said = f"{given[number]:.4g}"
        value = f"{full.standard[number]:.4g}"
        std = f"{full.standard_std[number]:.2g}"
        share = f"{100.0 * full.prior_share[number]:.0f}"
        basis = full.basis[number].value
        rows.append([name, full.units[number], said, value, std, basis, share])
    published = published_base(folder)
    base_rows = []
    for number, name in enumerate(found.system.base.names):
        known, known_std = published.get(name, (np.nan, np.nan))
        here = found.estimate.parameters[number], found.estimate.parameters_std[number]
        figures = (known, known_std, *here, full.base[number], full.base_std[number])
        base_rows.append(
            [name, *("" if np.isnan(figure) else f"{figure:.4g}" for figure in figures)]
        )
    return rows, base_rows, full


def agreement(base_rows: Sequence[Sequence[str]]) -> str:
    """Say how far the TX-40's base parameters are from the published ones,
    as a share of both σ together.
    """
    sigmas: dict[str, list[float]] = {"the fit": [], "the fit with the prior": []}
    for _, published, published_std, *others in base_rows:
        if not published:
            continue
        for name, value, std in zip(sigmas, others[::2], others[1::2], strict=True):
            both = float(np.hypot(float(std), float(published_std)))
            sigmas[name].append(abs(float(value) - float(published)) / both)
    moved = [abs(float(row[5]) - float(row[3])) / float(row[4]) for row in base_rows]
    said = [f"{name} {np.sum(np.array(one) < 2.0)} of {len(one)}" for name, one in sigmas.items()]
    return (
        f"base parameters within 2 σ of the published ones: {', '.join(said)}; the prior moves "
        f"them by {max(moved):.1f} σ of the fit at most"
    )


def write_csv(path: Path, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a table of the documentation."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(headings)
        writer.writerows(rows)


def main(arguments: list[str] | None = None) -> int:
    """Make the cells that are missing, then print and write the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.prior_study", description=__doc__
    )
    parser.add_argument("--cells", type=int, default=CELLS, help="of each robot")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument(
        "--tx40-tolerance", type=float, default=0.2, help="of the real robot's URDF"
    )
    options = parser.parse_args(arguments)
    cells = []
    for seed in range(1, options.cells + 1):
        for robot in ROBOTS:
            cells.append(kept(robot, seed, options.out))
            line = (
                f"{robot.name} {seed}: relative error {cells[-1]['relative_error_percent']:.2f} %"
            )
            print_line(line)
    summary = [without_prior(cells), *(of_prior(cells, tolerance) for tolerance in TOLERANCES)]
    for row in summary:
        for heading, figure in zip(HEADINGS, row, strict=False):
            print_line(f"{heading}: {figure}")
        print_line("")
    wrong = noticed(cells)
    for row in wrong:
        print_line(" | ".join(row))
    if options.cells >= CELLS:
        shift_names = [f"shift at {100.0 * tolerance:.0f} % σ" for tolerance in TOLERANCES]
        path = TABLES / "prior.csv"
        write_csv(
            path,
            HEADINGS,
            [row + [""] * (len(HEADINGS) - len(row)) for row in summary],
        )
        prior_noticed_path = TABLES / "prior-noticed.csv"
        write_csv(prior_noticed_path, ("robot", "tolerance", *KINDS), wrong)
        prior_gains_path = TABLES / "prior-gains.csv"
        write_csv(
            prior_gains_path,
            ("robot", "seed", "axis", "std %", "z", *shift_names),
            by_gain(cells),
        )
    folder = data_folder()
    if not (folder / "tx40").is_dir():
        print_line(
            f"found no {folder / 'tx40'}; expected the TX-40's recording there: its tables "
            "are not made"
        )
        return 0
    rows, base_rows, full = real_tx40(folder, options.tx40_tolerance)
    check = full.check
    by_data = sum(basis is RestsOn.DATA for basis in full.basis)
    print_line(
        f"\nreal TX-40, tolerance {options.tx40_tolerance:g}: {by_data} of {len(rows)} parameters "
        "by the data; misfit "
        f"{check.chi_square:.0f} for {check.degrees_of_freedom:.0f} degrees of freedom; masses "
        f"{check.mass_ratio:.2f} ± {check.mass_ratio_std:.2f} of the prior's; called wrong: "
        f"{check.is_wrong}; "
        f"bounded: {full.bounded}; least eigenvalue {full.eigenvalues.min():.2g}"
    )
    print_line(agreement(base_rows))
    headings = (
        "parameter",
        "unit",
        "prior",
        "value",
        "std",
        "basis",
        "prior's share of the variance %",
    )
    prior_tx40_path = TABLES / "prior-tx40.csv"
    write_csv(prior_tx40_path, headings, rows)
    headings = ("base parameter", "published", "std", "fit", "std", "with the prior", "std")
    prior_tx40_base_path = TABLES / "prior-tx40-base.csv"
    write_csv(prior_tx40_base_path, headings, base_rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
