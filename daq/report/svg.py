"""Drawings as SVG: intervals beside limits, values before and after, curves, a ranking; and a file of several.

In a page they take their colours from its style (`daq.report.html`), so that they follow dark mode and paper. A drawing
is `_WIDTH` wide, about that of a phone, so that its text keeps its size there. A curve has no more points than a screen
can show.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

from daq.report.html import DRAWING, LIGHT, spelled
from ident.arrays import FloatArray

_WIDTH, _ROW, _TOP, _FOOT = 360.0, 25.0, 6.0, 36.0
_LEFT, _RIGHT = 46.0, 96.0  #: Room for the names and for the numbers
_LETTER, _LONGEST = 8.5, 170.0  #: Width of a letter of a name, and of a name at most
_ROOM = 1.12  #: Length of a scale over the largest value on it


@dataclass(frozen=True, slots=True)
class Interval:
    """One row of `intervals`, all in the unit of the scale."""

    name: str  #: of the row
    value: float  #: NaN where there is none to draw
    half: float  #: half of its interval
    lower: float  #: limits of the value; infinite without one
    upper: float
    label: str  #: the value in words, beside the row


def intervals(rows: Sequence[Interval], title: str, unit: str) -> str:
    """Draw values with their intervals around zero, and the limits of each.

    The scale shows the limits where the values need a tenth of it or more. Else it is the values' own, and arrows at
    both ends say that the limits are beyond.
    """
    reach = _largest(abs(row.value) + row.half for row in rows)
    bounds = _largest([abs(bound) for r in rows for bound in (r.lower, r.upper)])
    to_scale = bounds == 0.0 or reach >= 0.1 * bounds
    # Below 0.1 a scale would only magnify noise.
    extent = _ROOM * max(reach, bounds if to_scale else 0.0, 0.1)
    scale = _Scale(-extent, extent, len(rows), _room(row.name for row in rows))
    parts = [*scale.frame(unit), _line(scale.x(0.0), _TOP, scale.x(0.0), scale.bottom, "zero")]
    for number, row in enumerate(rows):
        y = scale.y(number)
        low, high = (scale.x(min(max(bound, -extent), extent)) for bound in (row.lower, row.upper))
        if bounds > 0.0:
            parts.insert(0, f'<rect class="range" x="{low:.1f}" y="{y - 9:.1f}" width="{high - low:.1f}" height="18"/>')
        parts += [
            _line(scale.x(bound), y - 9, scale.x(bound), y + 9, "limit")
            for bound in (row.lower, row.upper)
            if abs(bound) <= extent
        ]
        if math.isfinite(row.value):
            parts.append(_line(scale.x(row.value - row.half), y, scale.x(row.value + row.half), y, "bar"))
            parts.append(_dot(scale.x(row.value), y, "dot"))
        parts += [_name(y + 4, row.name), _text(_WIDTH, y + 4, row.label, "end")]
    if not to_scale:
        parts += [
            _text(scale.left, scale.bottom + 47, "◂ limit", "soft"),
            _text(scale.right, scale.bottom + 47, "limit ▸", "soft end"),
        ]
    return _drawing(parts, title, scale.bottom + _FOOT + (0.0 if to_scale else 17.0))


def before_after_drawing(rows: Sequence[tuple[str, float, float]], title: str, unit: str) -> str:
    """Draw each value before (hollow) and after (full), from zero; NaN for one that is not known."""
    most = _ROOM * max(_largest([v for _, *both in rows for v in both]), 1e-9)
    scale = _Scale(0.0, most, len(rows), _room(name for name, *_ in rows))
    parts = list(scale.frame(unit))
    for number, (name, before, after) in enumerate(rows):
        y = scale.y(number)
        known = [value for value in (before, after) if math.isfinite(value)]
        if len(known) > 1:
            parts.append(_line(scale.x(before), y, scale.x(after), y, "bar"))
        if math.isfinite(before):
            parts.append(_dot(scale.x(before), y, "hollow"))
        if math.isfinite(after):
            parts.append(_dot(scale.x(after), y, "dot"))
        label = " → ".join(f"{value:.2f}" for value in known) or "-"
        parts += [_name(y + 4, name), _text(_WIDTH, y + 4, label, "end")]
    return _drawing(parts, title, scale.bottom + _FOOT)


@dataclass(frozen=True, slots=True)
class Line:
    """One curve of a chart, or a cloud of points."""

    x: FloatArray  #: shape (k,); ascending, unless the kind is a cloud
    y: FloatArray  #: shape (k,); NaN leaves a gap
    kind: str = "line"  #: CSS class: line, thin, wide, dashed, other; cloud and rest are points
    name: str = ""  #: in the legend, empty for none


def chart(
    lines: Sequence[Line],
    title: str,
    labels: tuple[str, str],
    *,
    half: FloatArray | None = None,
    reach: float = 0.0,
) -> str:
    """Draw curves over one variable.

    Args:
        lines: at least one, the first below the others.
        title: for readers who do not see the drawing.
        labels: of x and of y.
        half: half of the band around the first line, shape (k,); None for no band.
        reach: the scale of y reaches from -reach to reach at least, so that charts can share it.
    """
    first = lines[0]
    values = [line.y for line in lines]
    if half is not None:
        values += [first.y - half, first.y + half]
    values.append(np.array([0.0, reach, -reach]))
    low, high = _ends(values)
    begin, end = _ends([line.x for line in lines])
    across, left, top, height = _WIDTH - 8.0, 50.0, 22.0, 150.0

    def right(x: FloatArray) -> FloatArray:
        return left + (x - begin) / (end - begin) * (across - left)

    def down(y: FloatArray) -> FloatArray:
        return top + (high - y) / (high - low) * (height - top)

    parts = []
    for tick in _ticks(low, high):
        y = float(down(np.array(tick)))
        parts.append(_line(left, y, across, y, "zero" if tick == 0.0 else "grid"))
        parts.append(_text(left - 5, y + 4, f"{tick:g}", "soft end"))
    parts.extend(
        _text(float(right(np.array(tick))), height + 17, f"{tick:g}", "soft mid") for tick in _ticks(begin, end)
    )
    if half is not None:
        xs = np.concatenate([first.x, first.x[::-1]])
        ys = np.concatenate([first.y + half, (first.y - half)[::-1]])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(right(xs).tolist(), down(ys).tolist(), strict=True))
        parts.append(f'<polygon class="band" points="{points}"/>')
    for line in lines:
        draw = _points if line.kind in _CLOUDS else _curve
        parts.append(f'<path class="{line.kind}" d="{draw(right(line.x), down(line.y))}"/>')
    parts += [_text(0, 13, labels[1], "soft"), _text(across, height + 36, labels[0], "soft end")]
    named = [line for line in lines if line.name]
    bottom = height + (60 if named else 42)
    at = left
    for line in named:
        length = 0 if line.kind in _CLOUDS else 22
        sample = f"M{at:.0f} {bottom - 10:.0f}h{length}"
        parts += [f'<path class="{line.kind}" d="{sample}"/>', _text(at + 28, bottom - 6, line.name, "soft")]
        at += 40 + 7.5 * len(line.name)
    return _drawing(parts, title, bottom)


def _ends(columns: Iterable[FloatArray]) -> tuple[float, float]:
    """Least and largest of all known values, apart where they are one; 0 and 1 without any."""
    values = np.concatenate([*columns])
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    return low, high if high > low else low + 1.0


_CLOUDS = frozenset({"cloud", "rest"})  #: Kinds of lines that are points
_STRETCHES = 2 * round(_WIDTH)  #: Two a unit of the drawing's width, the dots of a fine screen


def visible_points(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Keep lowest and highest value of each stretch of a curve, and its gaps, so that no peak is lost.

    Args:
        x, y: shape (k,), NaN in y leaves a gap.
    """
    if len(x) <= 2 * _STRETCHES:
        return x, y
    kept = []
    for part in np.array_split(np.arange(len(x)), _STRETCHES):
        values = y[part]
        gap = np.flatnonzero(~np.isfinite(values))
        if len(gap) < len(part):
            kept += sorted({int(part[np.nanargmin(values)]), int(part[np.nanargmax(values)]), *part[gap[:1]].tolist()})
        else:
            kept.append(int(part[0]))
    return x[kept], y[kept]


def _curve(x: FloatArray, y: FloatArray) -> str:
    steps, pen = [], "M"
    for a, b in zip(*(column.tolist() for column in visible_points(x, y)), strict=True):
        if math.isfinite(b):
            steps.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(steps)


def _points(x: FloatArray, y: FloatArray) -> str:
    """Points as strokes of no length; those that fall on one place are drawn once."""
    places = np.unique(np.round(np.stack([x, y], axis=1)[np.isfinite(x) & np.isfinite(y)]), axis=0)
    return "".join(f"M{a:.0f} {b:.0f}h0" for a, b in places.tolist())


def ranking(rows: Sequence[tuple[str, float, str]], title: str, unit: str) -> str:
    """Draw bars under their names. A row: name, length, and CSS class: full, alike, empty."""
    names = [wrap(name, round((_WIDTH - 8.0) / _LETTER)) for name, _, _ in rows]
    lines = sum(map(len, names))
    longest = _ROOM * max(_largest(length for _, length, _ in rows), 1e-9)
    scale = _Scale(0.0, longest, (17.0 * lines + 25.0 * len(rows)) / _ROW, 8.0, 60.0)
    parts = list(scale.ticks(unit))
    y = _TOP
    for words, (_, length, kind) in zip(names, rows, strict=True):
        for line in words:
            y += 17.0
            parts.append(_text(0, y - 3, line))
        # The grid is drawn behind the bars alone: no line crosses a name.
        parts += scale.grid(y, y + 18.0)
        width = max(scale.x(max(length, 0.0)) - scale.x(0.0), 1.0)
        number = f"{length:.0f}" if abs(length) >= 100.0 else f"{length:.3g}"
        parts.append(
            f'<rect class="{kind}" x="{scale.x(0.0):.1f}" y="{y + 2:.1f}" width="{width:.1f}" height="14"/>'
            + _text(scale.x(0.0) + width + 5, y + 14, number, "soft")
        )
        y += 25.0
    return _drawing(parts, title, scale.bottom + _FOOT)


_COLUMNS = 2  #: Drawings beside each other


def sheet(drawings: Sequence[str], title: str) -> bytes:
    """Return a file of its own with several drawings under a title, in the colours of paper."""
    heights = [float(found[1]) for one in drawings if (found := re.search(r'viewBox="0 0 \S+ ([\d.]+)"', one))]
    across = min(_COLUMNS, len(drawings))
    gap = 24.0
    column_width = _WIDTH + gap
    row_height = max(heights) + gap
    width = across * column_width + gap
    height = math.ceil(len(drawings) / across) * row_height + 48.0
    style = re.sub(r"var\(--(\w+)\)", lambda found: LIGHT[found[1]], DRAWING)
    placed = []
    for number, (drawing, own_height) in enumerate(zip(drawings, heights, strict=True)):
        row, column = divmod(number, across)
        place = f'x="{gap + column * column_width:g}" y="{48 + row * row_height:g}"'
        placed.append(drawing.replace("<svg ", f'<svg {place} width="{_WIDTH:g}" height="{own_height:g}" ', 1))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}"><style>{style}</style><rect width="100%" height="100%" fill="{LIGHT["paper"]}"/>'
        f"{_text(gap, 28, title)}{''.join(placed)}</svg>\n"
    ).encode()


@dataclass(frozen=True, slots=True)
class _Scale:
    """Rows from above, and a scale from left to right."""

    low: float
    high: float
    rows: float
    left: float = _LEFT
    room: float = _RIGHT

    @property
    def right(self) -> float:
        return _WIDTH - self.room

    @property
    def bottom(self) -> float:
        return _TOP + _ROW * self.rows

    def x(self, value: float) -> float:
        return self.left + (value - self.low) / (self.high - self.low) * (self.right - self.left)

    def y(self, row: float) -> float:
        return _TOP + _ROW * (row + 0.5)

    def frame(self, unit: str) -> Iterator[str]:
        """Grid over all rows, and the numbers of the scale."""
        yield from self.grid(_TOP, self.bottom)
        yield from self.ticks(unit)

    def grid(self, top: float, bottom: float) -> Iterator[str]:
        """Lines at the numbers of the scale, between two heights."""
        for tick in _ticks(self.low, self.high):
            yield _line(self.x(tick), top, self.x(tick), bottom, "grid")

    def ticks(self, unit: str) -> Iterator[str]:
        """Numbers of the scale with their unit, below all rows; with a sign where some are negative."""
        for tick in _ticks(self.low, self.high):
            number = f"{tick:g}"
            if self.low < 0.0 < tick:
                number = f"+{number}"
            yield _text(self.x(tick), self.bottom + 14, number, "soft mid")
        yield _text((self.left + self.right) / 2, self.bottom + 30, unit, "soft mid")


def _ticks(low: float, high: float) -> Iterator[float]:
    """Round numbers between two ends, three to six of them."""
    raw = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= raw)
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        yield round(number * step, 12)


def _room(names: Iterable[str]) -> float:
    """Room to the left of a scale for the names of its rows."""
    return max(_LEFT, min(_LETTER * max(map(len, names), default=0), _LONGEST) + 10.0)


def _name(y: float, name: str) -> str:
    """Name of a row; one that is too long for its room is drawn narrower, not cut."""
    drawn = _text(0, y, name)
    narrow = f'<text textLength="{_LONGEST:g}" lengthAdjust="spacingAndGlyphs"'
    return drawn.replace("<text", narrow, 1) if _LETTER * len(name) > _LONGEST else drawn


def _largest(values: Iterable[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=0.0)


def _drawing(parts: Iterable[str], title: str, height: float) -> str:
    words = spelled(title)
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {height:g}" role="group" aria-label="{words}"><title>{words}</title>'
        f"{''.join(parts)}</svg>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _dot(x: float, y: float, kind: str) -> str:
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="4.5"/>'


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    named = f' class="{kind}"' if kind else ""
    return f'<text{named} x="{x:.1f}" y="{y:.1f}">{spelled(text)}</text>'
