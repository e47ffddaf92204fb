"""Two drawings of the documentation, made from the code: the house, and the way of one sample."""

from __future__ import annotations

import importlib
import itertools
import pkgutil
import re
import textwrap
from html import escape

COLOURS = {"daq": "#0072b2", "ident": "#009e73", "drivers": "#d55e00"}
JOBS = {
    "daq": "the service: files, jobs, reports, command line",
    "ident": "the science: arrays in, results out",
    "drivers": "the amplifiers: CANopen, streams, motion",
}
STYLE = "font-family:DejaVu Sans,Helvetica,Arial,sans-serif"
INK, FAINT = "#222222", "#666666"
LONGEST = 52
"""Letters of a line beside the name of a room."""

STATIONS = (
    ("bus", "drivers", "SYNC and PDOs"),
    ("stream", "drivers", "a Sample per SYNC"),
    ("log", "daq", "MCAP, raw counts"),
    ("dataset", "ident", "SI, filtered"),
    ("equations", "ident", "regressor, currents"),
    ("estimate", "ident", "gains ± σ"),
    ("residual", "ident", "on held-out moves"),
    ("effect", "ident", "friction, spring, …"),
    ("calibration", "daq", "calibration.yaml"),
    ("controller", "daq", "gates, audit, write"),
)
"""What a sample passes on its way: name, package and form there."""
AGAIN = ("effect", "equations")
"""From an accepted effect back to the fit."""


def house() -> str:
    """The packages with their rooms, and the direction of imports."""
    width, row, gap = 960, 21, 40
    columns = {"daq": (20, width - 40), "ident": (20, 450), "drivers": (490, 450)}
    rooms = {name: _rooms(name) for name in columns}
    in_two = (len(rooms["daq"]) + 1) // 2
    daq_height = 62 + row * in_two
    lower = 20 + daq_height + gap
    below = 62 + row * max(len(rooms["ident"]), len(rooms["drivers"]), 1)
    parts = [_package("daq", 20, 20, width - 40, daq_height)]
    for number, (room, job) in enumerate(rooms["daq"]):
        parts.append(_room(40 + 460 * (number // in_two), 84 + row * (number % in_two), room, job))
    for name in ("ident", "drivers"):
        x, size = columns[name]
        parts.append(_package(name, x, lower, size, below))
        parts += [_room(x + 20, lower + 64 + row * n, room, job) for n, (room, job) in enumerate(rooms[name])]
        middle = x + size // 2
        parts.append(_arrow(f"M{middle} {20 + daq_height} V{lower - 4}"))
        parts.append(_text(middle + 10, lower - 15, "imports", 12, FAINT))
    return _svg(width, lower + below + 20, parts)


def one_sample() -> str:
    """The stations from the bus to the controller, five a row."""
    wide, high, step_x, step_y = 164, 74, 190, 132
    places = {}
    for number, (name, _, _) in enumerate(STATIONS):
        line, column = divmod(number, 5)
        # The second row runs back below the first.
        places[name] = (16 + step_x * (column if line == 0 else 4 - column), 20 + step_y * line)
    parts = []
    for (first, _, _), (second, _, _) in itertools.pairwise(STATIONS):
        (x1, y1), (x2, y2) = places[first], places[second]
        if y1 != y2:
            path = f"M{x1 + wide / 2} {y1 + high} V{y2 - 4}"
        elif x2 > x1:
            path = f"M{x1 + wide} {y1 + high / 2} H{x2 - 4}"
        else:
            path = f"M{x1} {y1 + high / 2} H{x2 + wide + 4}"
        parts.append(_arrow(path))
    (x1, y1), (x2, y2) = (places[name] for name in AGAIN)
    half = (y1 + y2 + high) / 2
    parts.append(_arrow(f"M{x1 + wide / 2} {y1} V{half} H{x2 + 40} V{y2 + high + 4}", dashed=True))
    parts.append(_text(x1 + wide / 2 + 12, half - 6, "accepted: fit again", 12, FAINT))
    for name, package, form in STATIONS:
        x, y = places[name]
        parts += [
            _box(x, y, wide, high, COLOURS[package]),
            _text(x + 12, y + 24, name, 16, INK, bold=True),
            _text(x + 12, y + 44, form, 12.5, INK),
            _text(x + 12, y + 63, package, 11.5, COLOURS[package], bold=True),
        ]
    return _svg(step_x * 5 + 6, step_y + high + 40, parts)


def _rooms(package: str) -> list[tuple[str, str]]:
    """Subpackages with the first sentence of their docstring."""
    found = []
    module = importlib.import_module(package)
    for info in pkgutil.iter_modules(module.__path__):
        if info.ispkg:
            inner = importlib.import_module(f"{package}.{info.name}")
            job = re.split(r"\.(?=\s+[A-Z]|$)|: |; ", (inner.__doc__ or "").strip())[0].replace("`", "")
            if len(job) > LONGEST:
                job = re.sub(r" \(.*?\)", "", job)
            if len(job) > LONGEST:
                job = re.split(r", | or | that ", job)[0]
            found.append((info.name, textwrap.shorten(job, LONGEST, placeholder=" …")))
    return found


def _package(name: str, x: int, y: int, width: int, height: int) -> str:
    return (
        _box(x, y, width, height, COLOURS[name])
        + _text(x + 20, y + 32, f"{name}/", 18, COLOURS[name], bold=True)
        + _text(x + 110, y + 32, JOBS[name], 13.5, INK)
    )


def _room(x: int, y: int, name: str, job: str) -> str:
    return _text(x, y, name, 12.5, INK, bold=True) + _text(x + 112, y, job, 12, FAINT)


def _box(x: int, y: int, width: int, height: int, colour: str) -> str:
    place = f'x="{x}" y="{y}" width="{width}" height="{height}" rx="9"'
    return f'<rect {place} fill="{colour}" fill-opacity="0.11" stroke="{colour}" stroke-width="1.5"/>'


def _text(x: float, y: float, text: str, size: float, colour: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x}" y="{y}" font-size="{size}" fill="{colour}"{weight}>{escape(text)}</text>'


def _arrow(path: str, *, dashed: bool = False) -> str:
    dash = ' stroke-dasharray="6 4"' if dashed else ""
    return f'<path d="{path}" fill="none" stroke="{FAINT}" stroke-width="1.6"{dash} marker-end="url(#tip)"/>'


def _svg(width: float, height: float, parts: list[str]) -> str:
    tip = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0 L8 4 L0 8 z" fill="{FAINT}"/></marker></defs>'
    )
    # White below the drawing: a dark theme shows it too.
    ground = f'<rect width="{width}" height="{height}" rx="12" fill="#ffffff"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" style="{STYLE}">'
    return "\n".join([head, tip, ground, *parts, "</svg>", ""])
