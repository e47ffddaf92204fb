"""A plan as a page of its own: the arm moves through it, with swept volume, clearance and speeds.

Lines are the joint chain of the URDF; the bodies are the capsules that the clearance is computed
with. The swept volume is drawn from the same capsules at every row.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell
from daq.files import open_regular, replace_file, sha256
from daq.report.html import element, html_document, html_list, palette, visible_text
from daq.workflow.accepted_room import extent, placed
from daq.workflow.experiment import PlannedMove, experiment_of, path_of
from daq.workflow.plan import Plan
from ident.arrays import FloatArray
from ident.model.robot import poses
from ident.planning.clearance import Box, Capsule, Checker

#: Time between two rows of a preview, and their largest number
STEP_S = 0.04
LARGEST_ROWS = 1500
#: Text at the beginning of a page, before the digest of its plan
MARK = '<meta name="drivegain-plan" content="'
_GRID_M = 0.25  #: Side of a square of the drawn plane z = 0
HEAD_BYTES = 1024  #: Beginning of a page, in which the digest of its plan is
_AXES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B58900", "#3B9BD6", "#7F7F7F", "#882255")
_AXES_DARK = (
    "#4BA3E3",
    "#F08A4B",
    "#2FC298",
    "#E39BC4",
    "#E0B73C",
    "#9AD5FF",
    "#B5B5B5",
    "#D77AA8",
)
_LIGHT = {"base": "#8a8a8a", "swept": "#b9cbe0", "swept-edge": "#33567f", "footprint": "#a3a3a3"}
_DARK = {"base": "#8f8f8f", "swept": "#4d6e93", "swept-edge": "#bcd6f2", "footprint": "#6d6d6d"}
_LIGHT |= {f"axis-{number}": colour for number, colour in enumerate(_AXES)}
_DARK |= {f"axis-{number}": colour for number, colour in enumerate(_AXES_DARK)}
_STYLE = (
    palette(_LIGHT, _DARK)
    + """\
body { font: 16px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 64rem;
  margin: 1rem auto; padding: 0 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.4rem; margin: 0.5rem 0; } h2 { font-size: 1.05rem; margin: 1rem 0 0.2rem; }
ul { margin: 0.5rem 0; padding-left: 1.2rem; } p { margin: 0.3rem 0; color: var(--soft); } .act { color: var(--act); }
canvas { width: 100%; display: block; } #clearance { height: 9rem; }
#arm { height: min(60vh, 34rem); touch-action: none; cursor: grab; border: 1px solid var(--line); }
.controls { display: flex; flex-wrap: wrap; gap: 0.4rem 0.6rem; align-items: center; margin: 0.5rem 0; }
.controls input[type=range] { flex: 1 1 12rem; } button { font: inherit; padding: 0.35rem 0.9rem; }
#now { font-variant-numeric: tabular-nums; min-width: 22rem; } #now.act { font-weight: bold; }
@media (max-width: 40rem) { #arm { height: 50vh; } #now { min-width: 0; flex-basis: 100%; } }
@media print { .controls { display: none; } body { font-size: 10pt; max-width: none; margin: 0; }
  canvas { object-fit: contain; object-position: left; break-inside: avoid; } h2 { break-after: avoid; }
  #arm { height: 9cm; object-position: center; } #clearance { height: 3cm; } #speed { max-height: 6cm; } }
"""
)


def preview_page(
    cell: Cell, moves: Sequence[PlannedMove], checker: Checker, plan: bytes, purpose: str = ""
) -> str:
    """Build the page.

    Args:
        cell: with the limits.
        moves: of the plan; the page starts at the first target.
        checker: distances of the arm.
        plan: content of the plan file, whose digest the page carries.
        purpose: what the moves were planned for; empty for a first plan.
    """
    script = (Path(__file__).parent / "plan_preview.js").read_text(encoding="utf-8")
    drawn = preview_data(cell, moves, checker)
    data = json.dumps(drawn, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")  # no name in it ends the script
    planned_for = ""
    if purpose:
        planned_for = element("p", f"Planned for {purpose}", "act")
    body = f"""\
{element("h1", f"Plan for cell {cell.name}: {len(moves)} moves in {drawn['time_s'][-1]:.0f} s")}
{planned_for}
<canvas id="arm"></canvas>
<div class="controls"><button id="play">Play</button><input id="time" type="range" min="0" value="0" aria-label="time">
<span id="now" role="status"></span></div>
<div class="controls"><button data-view="home">3-D</button><button data-view="z">From above</button>
<button data-view="y">Along y</button><button data-view="x">Along x</button>
<button data-zoom="1.25" aria-label="zoom in">+</button><button data-zoom="0.8" aria-label="zoom out">−</button>
<label><input id="swept" type="checkbox" checked> swept volume</label></div>
<p>Drag to turn. Each link has the colour of the axis that moves it. Pale, with an outline: everywhere that a moving
part comes; grey on the grid: its footprint. A square of the grid is {1000 * _GRID_M:.0f} mm.</p>
{html_list(_facts(cell, checker, drawn))}
<h2>Clearance [mm]</h2>
<canvas id="clearance"></canvas>
<h2>Speed of each axis; full height is 100 % of its limit</h2>
<canvas id="speed"></canvas>
<script id="data" type="application/json">{data}</script>"""
    return html_document(f"Plan for {cell.name}", f'{MARK}{sha256(plan)}">', _STYLE, body, script)


def save_preview(cell: Cell, plan: Plan, file: Path, page: Path) -> None:
    """Write the page of a plan.

    Args:
        cell: with the limits.
        plan: as its file has it.
        file: of the plan; the page has its digest.
        page: to write; a file of that name is replaced.

    Raises:
        OSError: from the file system.
    """
    checker = experiment_of(cell).scene.checker
    content = preview_page(cell, plan.moves, checker, file.read_bytes(), plan.purpose)
    replace_file(page, content.encode())


def preview_data(cell: Cell, moves: Sequence[PlannedMove], checker: Checker) -> dict[str, Any]:
    """Compute what the page draws, in rows of equal time steps; lengths in m and mm."""
    time_s, position, speed, move = _rows(cell, moves)
    scene = checker.scene
    at = poses(checker.robot, checker.joints(position))
    ends_m = placed(checker, position)
    origins = at.origin_m.swapaxes(0, 1)
    reach = extent(checker, ends_m)
    clearance_mm = 1000.0 * (checker.margins(position) + scene.minimum_m)
    boxes = list(scene.boxes)
    if scene.workspace is not None:
        boxes.append(scene.workspace)
    seen = np.concatenate((origins.reshape(-1, 3), [reach.lower_m, reach.upper_m]))
    # A box that reaches far beyond the arm, such as a floor, must not make the arm small.
    span = float(np.linalg.norm(np.ptp(seen, axis=0)))
    corners = np.array([(box.lower_m, box.upper_m) for box in boxes]).reshape(-1, 3)
    lowest = seen.min(axis=0) - span / 2
    highest = seen.max(axis=0) + span / 2
    corners = np.clip(corners, lowest, highest)
    seen = np.concatenate((seen, corners))
    lower = seen.min(axis=0)
    upper = seen.max(axis=0)
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    capsules = [_drawn_capsule(capsule) for capsule in scene.capsules]
    drawn_boxes = []
    for box in boxes:
        is_obstacle = box is not scene.workspace
        drawn_boxes.append(_drawn_box(box, is_obstacle=is_obstacle))
    centre_m = 0.5 * (lower + upper)
    diagonal_m = float(np.linalg.norm(upper - lower))
    radius_m = 0.5 * diagonal_m + 0.05
    speed_percent = 100.0 * np.abs(speed / limits)
    speeds = []
    for name, column in zip(cell.axis_names, speed_percent.T, strict=True):
        speeds.append({"name": visible_text(name), "values": _rounded(column, 1)})
    known_mm = [round(value, 1) if np.isfinite(value) else None for value in clearance_mm.tolist()]
    return {
        "time_s": _rounded(time_s, 3),
        "move": move.tolist(),
        "moves": len(moves),
        "origins_m": _rounded(origins, 3),
        "ends_m": _rounded(ends_m, 3),
        "capsules": capsules,
        "boxes": drawn_boxes,
        "reach": {
            "lower_m": _rounded(reach.lower_m, 3),
            "upper_m": _rounded(reach.upper_m, 3),
            "radius_m": round(reach.radius_m, 3),
        },
        "grid_m": _GRID_M,
        "frame_m": [_rounded(lower, 3), _rounded(upper, 3)],
        "centre_m": _rounded(centre_m, 3),
        "radius_m": round(radius_m, 3),
        "clearance_mm": known_mm,
        "minimum_mm": 1000.0 * scene.minimum_m,
        "speeds": speeds,
    }


def _drawn_capsule(capsule: Capsule) -> dict[str, Any]:
    return {
        "name": visible_text(capsule.name),
        "link": capsule.link,
        "radius_m": capsule.radius_m,
    }


def _drawn_box(box: Box, *, is_obstacle: bool) -> dict[str, Any]:
    return {
        "name": visible_text(box.name),
        "lower_m": box.lower_m,
        "upper_m": box.upper_m,
        "obstacle": is_obstacle,
    }


def _facts(cell: Cell, checker: Checker, drawn: Mapping[str, Any]) -> Iterator[str]:
    """List what a person must know before approving the plan, a sentence each."""
    rows = zip(drawn["clearance_mm"], drawn["time_s"], strict=True)
    known = [(clearance_mm, at_s) for clearance_mm, at_s in rows if clearance_mm is not None]
    if known:
        least_mm, at_s = min(known)
        yield (
            f"Smallest clearance: {least_mm:.0f} mm, at {at_s:.1f} s; {drawn['minimum_mm']:.0f} "
            "mm must be kept."
        )
    reach = drawn["reach"]
    extents = zip("xyz", reach["lower_m"], reach["upper_m"], strict=True)
    ranges = ", ".join(f"{name} {low:+.2f} to {high:+.2f}" for name, low, high in extents)
    radius_m = reach["radius_m"]
    yield (
        f"The moving parts stay within {ranges} m, and within {radius_m:.2f} m of the z axis of "
        "the base."
    )
    if (lowest_m := reach["lower_m"][2]) < 0.0:
        yield (
            f"They come {-lowest_m:.2f} m below z = 0, the plane of the grid: is there a floor "
            "or a table?"
        )
    declared = cell.clearance is not None and bool(cell.clearance.capsules)
    shape = "a guess from the URDF; the real arm may be thicker"
    if declared:
        shape = "that of the cell file"
    if cell.chain is not None and not declared:
        shape = "unknown: links of a closed chain are not guessed, and nothing keeps them apart"
    yield f"The shape of the arm is {shape}."
    bodies = {"obstacle": checker.scene.boxes, "workspace": checker.scene.workspace}
    if missing := [word for word, found in bodies.items() if not found]:
        yield (
            f"The cell file declares no {' and no '.join(missing)}: tables, cables and people "
            "are not on this page."
        )
    checked = "nothing checks the way there"
    if cell.clearance is not None:
        checked = "drivegain record checks the way there"
    yield (
        "The page starts at the first target. Where the robot stands before is not known here; "
        f"{checked}."
    )


def _rows(
    cell: Cell, moves: Sequence[PlannedMove]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return time [s], position [rad or m], velocity and number of the move of each row,
    dwells included.
    """
    ways = [path_of(cell, np.array(before.target_rad), after) for before, after in pairwise(moves)]
    lengths_s = [way.duration_s + after.dwell_s for way, after in zip(ways, moves[1:], strict=True)]
    began_s = np.cumsum([moves[0].dwell_s, *lengths_s])
    duration_s = float(began_s[-1])
    step_s = max(STEP_S, duration_s / LARGEST_ROWS)
    time_s = np.arange(0.0, duration_s + step_s, step_s)
    position = np.tile(np.array(moves[0].target_rad), (len(time_s), 1))
    velocity = np.zeros_like(position)
    number = np.ones(len(time_s))
    for index, way in enumerate(ways):
        rows = time_s >= began_s[index]
        since_s = time_s[rows] - began_s[index]
        position[rows], velocity[rows], _ = way.at(since_s)
        number[rows] = index + 2
    return time_s, position, velocity, number


def _rounded(values: FloatArray, decimals: int) -> list[object]:
    return list(np.round(values, decimals).tolist())


def find_preview(plan: Path) -> Path | None:
    """Return the page in the folder of a plan that shows exactly its content;
    None without one that can be read.
    """
    with suppress(OSError):
        mark = f'{MARK}{sha256(plan.read_bytes())}"'.encode()
        for page in sorted(plan.parent.glob("*.html")):
            with suppress(OSError), open_regular(page) as stream:
                if mark in stream.read(HEAD_BYTES):
                    return page
    return None
