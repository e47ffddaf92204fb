"""Drawings of the documentation, made from the code: the house, the way of one sample, and the closed chains.

The closed chains are the shipped cells at their assembly pose, as the identification assembles them (`ident`).
"""

from __future__ import annotations

import importlib
import itertools
import pkgutil
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from daq.config.cell import robot_of
from daq.config.cell_file import load_cell
from ident.arrays import FloatArray
from ident.model.closed_chain import assemble
from ident.model.robot import JointKind, Place, poses
from ident.model.urdf import read_urdf

COLOURS = {"daq": "#0072b2", "ident": "#009e73", "drivers": "#d55e00"}
JOBS = {
    "daq": "the service: files, jobs, reports, command line",
    "ident": "the science: arrays in, results out",
    "drivers": "the amplifiers: CANopen, streams, motion",
}
STYLE = "font-family:DejaVu Sans,Helvetica,Arial,sans-serif"
INK, FAINT = "#222222", "#666666"
LONGEST = 52
"""Letters of a line next to the name of a room."""

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

CELLS = Path(__file__).resolve().parents[1] / "configs" / "cells"
MECHANISMS = {"five-bar": "Five-bar", "orthoglide": "Orthoglide", "dualv": "DualV-like robot"}
"""Shipped closed chains: file of the cell and heading."""
ABOVE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""View on the plane of a planar mechanism: to the right and upwards, in the base frame."""
OBLIQUE = np.array([[-0.6428, 0.766, 0.0], [-0.3830, -0.3214, 0.866]])
"""The same of a spatial one: from 50° azimuth and 30° elevation."""
MOTOR, CLOSED, CARRIED = "#d55e00", "#0072b2", "#009e73"


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
        parts += [
            _room(x + 20, lower + 64 + row * n, room, job)
            for n, (room, job) in enumerate(rooms[name])
        ]
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


def mechanisms() -> str:
    """The shipped closed chains at their assembly pose, and the marks of their parts."""
    wide, high, head, foot = 330, 300, 62, 56
    parts = []
    for column, (name, heading) in enumerate(MECHANISMS.items()):
        left, shown = 20 + column * wide, mechanism(name)
        remark = f"{len(shown.motors)} motors, {shown.mobility} degrees of freedom"
        parts += [_text(left, 34, heading, 16, INK, bold=True), _text(left, 53, remark, 12, FAINT)]
        parts += _stick_figure(shown, left + 15, head + 15, wide - 60, high - 30)
    for place, (mark, words) in enumerate(
        (
            (_motor(0.0, 0.0), "motor"),
            (_passive(0.0, 0.0), "passive joint"),
            (_closing(0.0, 0.0), "closure, where a loop is cut"),
            (_carried(0.0, 0.0), "platform"),
        )
    ):
        x = 30 + (0, 100, 250, 490)[place]
        parts += [f'<g transform="translate({x} {head + high + 24})">{mark}</g>']
        parts.append(_text(x + 16, head + high + 28, words, 12.5, INK))
    return _svg(3 * wide + 20, head + high + foot, parts)


@dataclass(frozen=True, slots=True)
class Mechanism:
    """Points of a closed chain at its assembly pose, seen along one direction [m]; each of shape (2,)."""

    bodies: tuple[
        tuple[FloatArray, ...], ...
    ]  #: of each link the points where others join it, that of its joint first
    mobility: int  #: degrees of freedom
    carrier: int  #: index of the link that carries the payload
    motors: tuple[FloatArray, ...]
    rails: tuple[tuple[FloatArray, FloatArray], ...]  #: travel of each prismatic motor's joint
    passive: tuple[FloatArray, ...]
    closures: tuple[tuple[FloatArray, FloatArray], ...]  #: both ends of each
    platform: FloatArray


def mechanism(name: str) -> Mechanism:
    """Assemble a shipped cell's robot, and look at it."""
    cell = load_cell(CELLS / f"{name}.yaml")
    robot, chain = robot_of(cell), cell.chain
    if chain is None or chain.platform is None:
        raise ValueError(f"{name} is no closed chain with a platform")
    assembly = assemble(robot)
    placed = poses(robot, assembly.position_rad[None])
    turned, at = placed.rotation[:, 0], placed.origin_m[:, 0]
    planar = all(abs(joint.translation_m[2]) < 1e-9 for joint in robot.joints)
    view = ABOVE if planar else OBLIQUE

    def seen(place: Place) -> FloatArray:
        return np.asarray(
            view @ (at[place.joint + 1] + turned[place.joint + 1] @ place.translation_m)
        )

    def points(link: int) -> Iterator[FloatArray]:
        yield view @ at[link + 1]
        yield from (
            view @ at[number + 1]
            for number, joint in enumerate(robot.joints)
            if joint.parent == link
        )
        ends = (end for closure in robot.closures for end in (closure.first, closure.second))
        yield from (seen(end) for end in ends if end.joint == link)

    rails = []
    for axis, joint, number in zip(cell.axes, robot.axes, robot.axis_joints, strict=True):
        if joint.kind is JointKind.PRISMATIC:
            along = view @ turned[number + 1] @ joint.axis
            lower, upper = axis.limits.position
            rails.append(
                (view @ at[number + 1] + along * lower, view @ at[number + 1] + along * upper)
            )
    return Mechanism(
        bodies=tuple(tuple(points(link)) for link in range(robot.joint_count)),
        mobility=assembly.mobility,
        carrier=robot.carrier,
        motors=tuple(view @ at[joint + 1] for joint in robot.axis_joints),
        rails=tuple(rails),
        passive=tuple(view @ at[joint + 1] for joint in robot.passive_joints),
        closures=tuple((seen(closure.first), seen(closure.second)) for closure in robot.closures),
        platform=seen(read_urdf(cell.urdf).links[chain.platform]),
    )


def _stick_figure(shown: Mechanism, x: float, y: float, width: float, height: float) -> list[str]:
    """A mechanism in a box of the page: rails, links, platform, then the marks."""
    every = np.array([*itertools.chain(*shown.bodies, *shown.rails), shown.platform])
    lower, upper = every.min(axis=0), every.max(axis=0)
    scale = float(min(np.array([width, height]) / (upper - lower)))
    middle = 0.5 * (lower + upper)

    def on_page(point: FloatArray) -> tuple[float, float]:
        right, up = scale * (point - middle)
        return float(x + width / 2 + right), float(y + height / 2 - up)

    def line(
        points: tuple[FloatArray, ...], colour: str, stroke: float, *, filled: bool = False
    ) -> str:
        spelled = " ".join(f"{a:.1f},{b:.1f}" for a, b in map(on_page, points))
        look = f'fill="{colour if filled else "none"}" fill-opacity="0.18" stroke-linejoin="round"'
        kind = "polygon" if filled else "polyline"
        return f'<{kind} points="{spelled}" {look} stroke="{colour}" stroke-width="{stroke}" stroke-linecap="round"/>'

    parts = [line(rail, "#bbbbbb", 7) for rail in shown.rails]
    for link, body in enumerate(shown.bodies):
        if link == shown.carrier and len(body) > 2:
            parts.append(line(_around(body), CARRIED, 2.5, filled=True))
        else:
            parts += [line((body[0], end), INK, 2.5) for end in body[1:]]
    parts.append(_carried(*on_page(shown.platform)))
    parts += [_motor(*on_page(point)) for point in shown.motors]
    parts += [_passive(*on_page(point)) for point in shown.passive]
    return parts + [_closing(*on_page(first)) for first, _ in shown.closures]


def _around(body: tuple[FloatArray, ...]) -> tuple[FloatArray, ...]:
    """The points of a body in the order of their direction from its middle."""
    middle = np.mean(body, axis=0)
    return tuple(sorted(body, key=lambda point: float(np.arctan2(*(point - middle)))))


def _motor(x: float, y: float) -> str:
    return f'<circle class="motor" cx="{x:.1f}" cy="{y:.1f}" r="8.5" fill="{MOTOR}"/>'


def _passive(x: float, y: float) -> str:
    return f'<circle class="passive" cx="{x:.1f}" cy="{y:.1f}" r="3.8" fill="#ffffff" stroke="{INK}" stroke-width="1.6"/>'


def _closing(x: float, y: float) -> str:
    return f'<circle class="closure" cx="{x:.1f}" cy="{y:.1f}" r="8" fill="none" stroke="{CLOSED}" stroke-width="2.2"/>'


def _carried(x: float, y: float) -> str:
    place = f'x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10"'
    return f'<rect class="platform" {place} fill="{CARRIED}"/>'


def _rooms(package: str) -> list[tuple[str, str]]:
    """Subpackages with the first sentence of their docstring."""
    found = []
    module = importlib.import_module(package)
    for info in pkgutil.iter_modules(module.__path__):
        if info.ispkg:
            inner = importlib.import_module(f"{package}.{info.name}")
            job = re.split(r"\.(?=\s+[A-Z]|$)|: |; ", (inner.__doc__ or "").strip())[0].replace(
                "`", ""
            )
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
    return (
        f'<rect {place} fill="{colour}" fill-opacity="0.11" stroke="{colour}" stroke-width="1.5"/>'
    )


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
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" style="{STYLE}">'
    )
    return "\n".join([head, tip, ground, *parts, "</svg>", ""])
