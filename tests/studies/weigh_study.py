"""Coverage of the σ of a weighed body, over cells with load friction whose calibration found it.

    python -m tests.studies.weigh_study --cells 100 --arm tx40

Each cell has noise, motions and a body of its own (tests/ident/weighed.py). Its figures are kept in
out/weigh/<arm>/, and a cell that is there is not computed again, so that the study may be
interrupted.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from daq.files import replace_file
from ident.weighing import WeighedBody, weigh
from tests.ident.recordings import FloatArray, three_axes_truth, tx40_truth
from tests.ident.weighed import WeighedCell, weighed_cell

OUT = Path("out/weigh")
ARMS = {"tx40": tx40_truth, "three": three_axes_truth}
QUANTITIES = ("mass", "centre x", "centre y", "centre z")
WAYS = ("known robot", "bare run")


def cell_figures(arm: str, seed: int) -> dict[str, dict[str, list[float]]]:
    """Error and σ of each of QUANTITIES in each of WAYS [kg, m]."""
    truth = ARMS[arm]()
    cell = weighed_cell(truth, seed)
    found = {
        way: weigh(cell.calibration, truth.model, [cell.loaded], cell.conditioning, bare=bare)
        for way, bare in zip(WAYS, ([], [cell.bare]), strict=True)
    }
    return {way: errors(cell, body) for way, body in found.items()}


def errors(cell: WeighedCell, body: WeighedBody) -> dict[str, list[float]]:
    """Errors and their σ, and the mass."""
    mass = cell.body[-1]
    first = cell.body[6:9]
    centre, std = body.centre_m
    mass_difference_kg = body.mass_kg - mass
    return {
        "error": [mass_difference_kg, *(centre - first / mass).tolist()],
        "std": [body.mass_std_kg, *std.tolist()],
        "mass_kg": [mass],
    }


def table(cells: list[dict[str, Any]]) -> str:
    """Root mean square error, z and coverage of the 95 % intervals of each way and quantity."""
    lines = ["| way | quantity | rms error | rms z | inside 1.96 σ |", "|---|---|---|---|---|"]
    for way in WAYS:
        error = np.array([cell[way]["error"] for cell in cells])
        std = np.array([cell[way]["std"] for cell in cells])
        mass_kg = [cell[way]["mass_kg"] for cell in cells]
        mass = np.array(mass_kg)
        shown: FloatArray = np.column_stack((100.0 * error[:, :1] / mass, 1000.0 * error[:, 1:]))
        z = error / std
        for index, quantity in enumerate(QUANTITIES):
            rms = np.sqrt(np.mean(shown[:, index] ** 2))
            inside = np.mean(np.abs(z[:, index]) < 1.96)
            unit = "%" if index == 0 else "mm"
            spread = np.sqrt(np.mean(z[:, index] ** 2))
            lines.append(
                f"| {way} | {quantity} | {rms:.2f} {unit} | {spread:.2f} | {100.0 * inside:.0f} % |"
            )
        lines.append(
            f"| {way} | pooled | | {np.sqrt(np.mean(z**2)):.2f} | "
            f"{100.0 * np.mean(np.abs(z) < 1.96):.1f} % |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Compute the cells that are missing and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.weigh_study", description=__doc__
    )
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--arm", choices=tuple(ARMS), default="tx40")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    folder = options.out / options.arm
    folder.mkdir(parents=True, exist_ok=True)
    cells = []
    for seed in range(options.cells):
        path = folder / f"{seed}.json"
        if not path.exists():
            content = json.dumps(cell_figures(options.arm, seed)).encode()
            replace_file(path, content)
        text = path.read_text(encoding="utf-8")
        cells.append(json.loads(text))
    sys.stdout.write(f"{len(cells)} cells of {options.arm}\n\n{table(cells)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
