"""A plan as a page of its own: the arm moves through it, with swept volume, clearance and speeds.

Lines are the joint chain of the URDF; thick lines are the capsules that the clearance is computed with.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.files import open_regular, sha256
from daq.workflow.experiment import PlannedMove, path_of
from ident.arrays import FloatArray
from ident.model.robot import poses
from ident.planning.clearance import Checker

STEP_S, LARGEST_ROWS = 0.04, 1500  #: Time between two rows of a preview, and their largest number
MARK = '<meta name="drivegain-plan" content="'  #: Text at the beginning of a page, before the digest of its plan
HEAD_BYTES = 1024  #: Beginning of a page, in which the digest of its plan is
_STYLE = """
:root { color-scheme: light dark; --ink: #222; --grid: #ddd; --paper: #fff; }
@media (prefers-color-scheme: dark) { :root { --ink: #ddd; --grid: #444; --paper: #181818; } }
body { font: 16px/1.45 sans-serif; color: var(--ink); background: var(--paper); max-width: 75em; margin: 1em auto;
  padding: 0 1em; }
h1 { font-size: 1.4em; } h2 { font-size: 1em; margin: 0.8em 0 0.2em; }
canvas { width: 100%; display: block; } #arm { height: min(60vh, 34em); touch-action: none; cursor: grab; }
#clearance, #speed { height: 10em; }
.controls { display: flex; flex-wrap: wrap; gap: 0.4em 1em; align-items: center; }
.controls input[type=range] { flex: 1 1 12em; } button { font: inherit; padding: 0.3em 1em; }
.axis { white-space: nowrap; margin-right: 1em; } .axis::before { content: "\\25AC "; color: var(--axis); }
"""
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B58900", "#56B4E9", "#7F7F7F", "#882255")


def preview_page(cell: Cell, moves: Sequence[PlannedMove], checker: Checker, plan: bytes) -> str:
    """Build the page.

    Args:
        cell: with the limits.
        moves: of the plan; the page starts at the first target.
        checker: distances of the arm.
        plan: content of the plan file, whose digest the page carries.
    """
    script = (Path(__file__).parent / "plan_preview.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    data = json.dumps(preview_data(cell, moves, checker), separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")  # no name in it ends the script
    legend = " ".join(
        f'<span class="axis" style="--axis: {_COLOURS[index % len(_COLOURS)]}">{escape(name)}</span>'
        for index, name in enumerate(cell.axis_names)
    )
    shape = "as declared in the cell file" if cell.clearance and cell.clearance.capsules else "guessed from the URDF"
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{MARK}{sha256(plan)}">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'sha256-{digest}'; \
style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Plan for {escape(cell.name)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>Plan for cell {escape(cell.name)}: {len(moves)} moves</h1>
<canvas id="arm"></canvas>
<div class="controls"><button id="play">Play</button><input id="time" type="range" min="0" value="0" aria-label="time">
<label><input id="swept" type="checkbox" checked> swept volume</label><span id="now"></span></div>
<p>Drag to turn, scroll to zoom. The arm's shape is {shape}. Green: workspace; orange: obstacles. The page starts at the
first target: where the robot stands before is not known here.</p>
<h2>Clearance [mm]; orange: the smallest distance allowed</h2>
<canvas id="clearance"></canvas>
<h2>Speed of each axis [% of its limit]</h2>
<canvas id="speed"></canvas>
<p>{legend}</p>
<script id="data" type="application/json">{data}</script>
<script>{script}</script>
</body>
</html>
"""


def preview_data(cell: Cell, moves: Sequence[PlannedMove], checker: Checker) -> dict[str, object]:
    """Compute what the page draws, in rows of equal time steps; lengths in m and mm."""
    time_s, position, speed, move = _rows(cell, moves)
    at, capsules = poses(checker.robot, position), checker.scene.capsules
    frame = [capsule.link + 1 for capsule in capsules]
    ends = np.array([(capsule.start_m, capsule.end_m) for capsule in capsules]).reshape(-1, 1, 2, 3)
    placed = np.einsum("ckij,cxej->kcei", at.rotation[frame], ends) + at.origin_m[frame].swapaxes(0, 1)[:, :, None]
    origins = at.origin_m.swapaxes(0, 1)
    seen = np.concatenate((origins.reshape(-1, 3), placed.reshape(-1, 3)))
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    clearance_mm = 1000.0 * (checker.margins(position) + checker.scene.minimum_m)
    boxes = [*checker.scene.boxes, *([] if checker.scene.workspace is None else [checker.scene.workspace])]
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    return {
        "time_s": _rounded(time_s, 3),
        "move": move.tolist(),
        "moves": len(moves),
        "colours": _COLOURS,
        "origins_m": _rounded(origins, 3),
        "ends_m": _rounded(placed, 3),
        "capsules": [{"name": one.name, "link": one.link, "radius_m": one.radius_m} for one in capsules],
        "boxes": [{"name": one.name, "lower_m": one.lower_m, "upper_m": one.upper_m} for one in boxes],
        "centre_m": _rounded(0.5 * (lower + upper), 3),
        "radius_m": round(0.5 * float(np.linalg.norm(upper - lower)) + 0.05, 3),
        "clearance_mm": [round(value, 1) if np.isfinite(value) else None for value in clearance_mm.tolist()],
        "minimum_mm": 1000.0 * checker.scene.minimum_m,
        "speeds": [
            {"name": name, "values": _rounded(column, 1)}
            for name, column in zip(cell.axis_names, 100.0 * np.abs(speed / limits).T, strict=True)
        ],
    }


def _rows(cell: Cell, moves: Sequence[PlannedMove]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return time [s], position [rad or m], velocity and number of the move of each row, dwells included."""
    ways = [path_of(cell, np.array(before.target_rad), after) for before, after in pairwise(moves)]
    lengths = [way.duration_s + after.dwell_s for way, after in zip(ways, moves[1:], strict=True)]
    began = np.cumsum([moves[0].dwell_s, *lengths])
    step_s = max(STEP_S, float(began[-1]) / LARGEST_ROWS)
    time_s = np.arange(0.0, float(began[-1]) + step_s, step_s)
    position = np.tile(np.array(moves[0].target_rad), (len(time_s), 1))
    velocity, number = np.zeros_like(position), np.ones(len(time_s))
    for index, way in enumerate(ways):
        rows = time_s >= began[index]
        position[rows], velocity[rows], _ = way.at(time_s[rows] - began[index])
        number[rows] = index + 2
    return time_s, position, velocity, number


def _rounded(values: FloatArray, decimals: int) -> list[object]:
    return list(np.round(values, decimals).tolist())


def find_preview(plan: Path) -> Path | None:
    """Return the page beside a plan that was made of exactly its content; None without one that can be read."""
    with suppress(OSError):
        mark = f'{MARK}{sha256(plan.read_bytes())}"'.encode()
        for page in sorted(plan.parent.glob("*.html")):
            with suppress(OSError), open_regular(page) as stream:
                if mark in stream.read(HEAD_BYTES):
                    return page
    return None
