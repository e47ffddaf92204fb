"""Drawings as SVG: intervals with limits, values before and after, curves, a ranking;
and a file of several.

In a page they take their colours from its style (`daq.report.html`), so that they follow dark mode
and paper. A drawing is `_WIDTH` wide, about that of a phone, so that its text keeps its size there.
A curve has no more points than a screen can show.
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

_WIDTH = 360.0
_ROW = 25.0
_TOP = 6.0
_FOOT = 36.0
#: Room for the names and for the numbers
_LEFT = 46.0
_RIGHT = 96.0
#: Width of a letter of a name, and of a name at most
_LETTER = 8.5
_LONGEST = 170.0
_ROOM = 1.12  #: Length of a scale over the largest value on it


@dataclass(frozen=True, slots=True)
class Interval:
    """One row of `intervals`, all in the unit of the scale."""

    name: str  #: of the row
    value: float  #: NaN where there is none to draw
    half: float  #: half of its interval
    lower: float  #: limits of the value; infinite without one
    upper: float
    label: str  #: the value in words, to the right of the row


def intervals(rows: Sequence[Interval], title: str, unit: str) -> str:
    """Draw values with their intervals around zero, and the limits of each.

    The scale shows the limits where the values need a tenth of it or more. Else it is the values'
    own, and arrows at both ends say that the limits are beyond.
    """
    reach = _largest(abs(row.value) + row.half for row in rows)
    lowest_bound = _largest(abs(row.lower) for row in rows)
    highest_bound = _largest(abs(row.upper) for row in rows)
    bounds = max(lowest_bound, highest_bound)
    shows_limits = bounds == 0.0 or reach >= 0.1 * bounds
    # Below 0.1 a scale would only magnify noise.
    largest = max(reach, 0.1)
    if shows_limits:
        largest = max(largest, bounds)
    extent = _ROOM * largest
    left = _room(row.name for row in rows)
    scale = _Scale(-extent, extent, len(rows), left)
    zero = scale.x(0.0)
    parts = [*scale.frame(unit), _line(zero, _TOP, zero, scale.bottom, "zero")]
    for number, row in enumerate(rows):
        y = scale.y(number)
        if bounds > 0.0:
            # Behind everything else.
            parts.insert(0, _range(row, scale, y))
        parts += _interval_marks(row, scale, y)
        parts.append(_name(y + 4, row.name))
        parts.append(_text(_WIDTH, y + 4, row.label, "end"))
    height = scale.bottom + _FOOT
    if not shows_limits:
        height += 17.0
        below = scale.bottom + 47
        parts.append(_text(scale.left, below, "◂ limit", "soft"))
        parts.append(_text(scale.right, below, "limit ▸", "soft end"))
    return _drawing(parts, title, height)


def _range(row: Interval, scale: _Scale, y: float) -> str:
    """Draw what the limits of a row allow, as far as the scale shows it."""
    low = scale.x(scale.clipped(row.lower))
    high = scale.x(scale.clipped(row.upper))
    width = high - low
    return f'<rect class="range" x="{low:.1f}" y="{y - 9:.1f}" width="{width:.1f}" height="18"/>'


def _interval_marks(row: Interval, scale: _Scale, y: float) -> Iterator[str]:
    """Draw the limits of a row that are on the scale, and its value with its interval."""
    for bound in (row.lower, row.upper):
        if abs(bound) <= scale.high:
            x = scale.x(bound)
            yield _line(x, y - 9, x, y + 9, "limit")
    if math.isfinite(row.value):
        begin = scale.x(row.value - row.half)
        end = scale.x(row.value + row.half)
        yield _line(begin, y, end, y, "bar")
        yield _dot(scale.x(row.value), y, "dot")


def before_after_drawing(rows: Sequence[tuple[str, float, float]], title: str, unit: str) -> str:
    """Draw each value before (hollow) and after (full), from zero;
    NaN for one that is not known.
    """
    most_before = _largest(before for _, before, _ in rows)
    most_after = _largest(after for _, _, after in rows)
    most = _ROOM * max(most_before, most_after, 1e-9)
    left = _room(name for name, _, _ in rows)
    scale = _Scale(0.0, most, len(rows), left)
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
        parts.append(_name(y + 4, name))
        parts.append(_text(_WIDTH, y + 4, label, "end"))
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
    across = _WIDTH - 8.0
    left = 50.0
    top = 22.0
    height = 150.0

    def right(x: FloatArray) -> FloatArray:
        share = (x - begin) / (end - begin)
        return left + share * (across - left)

    def down(y: FloatArray) -> FloatArray:
        share = (high - y) / (high - low)
        return top + share * (height - top)

    parts = []
    for tick in _ticks(low, high):
        y = float(down(np.array(tick)))
        kind = "grid"
        if tick == 0.0:
            kind = "zero"
        parts.append(_line(left, y, across, y, kind))
        parts.append(_text(left - 5, y + 4, f"{tick:g}", "soft end"))
    for tick in _ticks(begin, end):
        x = float(right(np.array(tick)))
        parts.append(_text(x, height + 17, f"{tick:g}", "soft mid"))
    if half is not None:
        upper = down(first.y + half)
        lower = down(first.y - half)
        parts.append(_band(right(first.x), lower, upper))
    for line in lines:
        draw = _curve
        if line.kind in _CLOUDS:
            draw = _points
        path = draw(right(line.x), down(line.y))
        parts.append(f'<path class="{line.kind}" d="{path}"/>')
    label_x, label_y = labels
    parts.append(_text(0, 13, label_y, "soft"))
    parts.append(_text(across, height + 36, label_x, "soft end"))
    named = [line for line in lines if line.name]
    bottom = height + 42
    if named:
        bottom = height + 60
    at = left
    for line in named:
        length = 22
        if line.kind in _CLOUDS:
            length = 0
        parts.append(f'<path class="{line.kind}" d="M{at:.0f} {bottom - 10:.0f}h{length}"/>')
        parts.append(_text(at + 28, bottom - 6, line.name, "soft"))
        at += 40 + 7.5 * len(line.name)
    return _drawing(parts, title, bottom)


def _band(x: FloatArray, lower: FloatArray, upper: FloatArray) -> str:
    """Draw the area between two curves over the same places."""
    xs = np.concatenate([x, x[::-1]])
    ys = np.concatenate([upper, lower[::-1]])
    corners = zip(xs.tolist(), ys.tolist(), strict=True)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    return f'<polygon class="band" points="{points}"/>'


def _ends(columns: Iterable[FloatArray]) -> tuple[float, float]:
    """Least and largest of all known values, apart where they are one; 0 and 1 without any."""
    values = np.concatenate([*columns])
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low = float(known.min())
    high = float(known.max())
    if high == low:
        high = low + 1.0
    return low, high


_CLOUDS = frozenset({"cloud", "rest"})  #: Kinds of lines that are points
_STRETCHES = 2 * round(_WIDTH)  #: Two a unit of the drawing's width, the dots of a fine screen


def visible_points(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Select lowest and highest value of each stretch of a curve, and its gaps,
    so that no peak is lost.

    Args:
        x, y: shape (k,), NaN in y leaves a gap.
    """
    if len(x) <= 2 * _STRETCHES:
        return x, y
    selected: list[int] = []
    for part in np.array_split(np.arange(len(x)), _STRETCHES):
        values = y[part]
        gap = np.flatnonzero(~np.isfinite(values))
        if len(gap) == len(part):
            selected.append(int(part[0]))
            continue
        lowest = int(part[np.nanargmin(values)])
        highest = int(part[np.nanargmax(values)])
        first_gap = part[gap[:1]].tolist()
        selected += sorted({lowest, highest, *first_gap})
    return x[selected], y[selected]


def _curve(x: FloatArray, y: FloatArray) -> str:
    steps = []
    pen = "M"
    x, y = visible_points(x, y)
    for right, down in zip(x.tolist(), y.tolist(), strict=True):
        if math.isfinite(down):
            steps.append(f"{pen}{right:.1f} {down:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(steps)


def _points(x: FloatArray, y: FloatArray) -> str:
    """Points as strokes of no length; those that fall on one place are drawn once."""
    known = np.isfinite(x) & np.isfinite(y)
    points = np.stack([x, y], axis=1)[known]
    places = np.unique(np.round(points), axis=0)
    return "".join(f"M{right:.0f} {down:.0f}h0" for right, down in places.tolist())


def ranking(rows: Sequence[tuple[str, float, str]], title: str, unit: str) -> str:
    """Draw bars under their names. A row: name, length, and CSS class: full, alike, empty."""
    letters = round((_WIDTH - 8.0) / _LETTER)
    names = [wrap(name, letters) for name, _, _ in rows]
    lines = sum(map(len, names))
    height = 17.0 * lines + 25.0 * len(rows)
    longest = _largest(length for _, length, _ in rows)
    extent = _ROOM * max(longest, 1e-9)
    scale = _Scale(0.0, extent, height / _ROW, left=8.0, room=60.0)
    zero = scale.x(0.0)
    parts = list(scale.ticks(unit))
    y = _TOP
    for words, (_, length, kind) in zip(names, rows, strict=True):
        for line in words:
            y += 17.0
            parts.append(_text(0, y - 3, line))
        # The grid is drawn behind the bars alone: no line crosses a name.
        parts += scale.grid(y, y + 18.0)
        end = scale.x(max(length, 0.0))
        width = max(end - zero, 1.0)
        number = f"{length:.3g}"
        if abs(length) >= 100.0:
            number = f"{length:.0f}"
        parts.append(
            f'<rect class="{kind}" x="{zero:.1f}" y="{y + 2:.1f}" width="{width:.1f}" height="14"/>'
        )
        parts.append(_text(zero + width + 5, y + 14, number, "soft"))
        y += 25.0
    return _drawing(parts, title, scale.bottom + _FOOT)


_COLUMNS = 2  #: Drawings in a row


def sheet(drawings: Sequence[str], title: str) -> bytes:
    """Return a file with several drawings under a title, in the colours of paper."""
    heights = [_height(drawing) for drawing in drawings]
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
        x = gap + column * column_width
        y = 48 + row * row_height
        opening = f'<svg x="{x:g}" y="{y:g}" width="{_WIDTH:g}" height="{own_height:g}" '
        placed.append(drawing.replace("<svg ", opening, 1))
    content = "".join(placed)
    paper = LIGHT["paper"]
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" '
        f'height="{height:g}"><style>{style}</style><rect width="100%" height="100%" '
        f'fill="{paper}"/>'
        f"{_text(gap, 28, title)}{content}</svg>\n"
    )
    return text.encode()


def _height(drawing: str) -> float:
    """Height of a drawing of `_drawing`."""
    found = re.search(r'viewBox="0 0 \S+ ([\d.]+)"', drawing)
    if found is None:
        raise ValueError(
            f"found {drawing[:80]!r}; expected a drawing of this module with its height in viewBox"
        )
    return float(found[1])


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
        share = (value - self.low) / (self.high - self.low)
        return self.left + share * (self.right - self.left)

    def clipped(self, value: float) -> float:
        return min(max(value, self.low), self.high)

    def y(self, row: float) -> float:
        return _TOP + _ROW * (row + 0.5)

    def frame(self, unit: str) -> Iterator[str]:
        """Grid over all rows, and the numbers of the scale."""
        yield from self.grid(_TOP, self.bottom)
        yield from self.ticks(unit)

    def grid(self, top: float, bottom: float) -> Iterator[str]:
        """Lines at the numbers of the scale, between two heights."""
        for tick in _ticks(self.low, self.high):
            x = self.x(tick)
            yield _line(x, top, x, bottom, "grid")

    def ticks(self, unit: str) -> Iterator[str]:
        """Numbers of the scale with their unit, below all rows;
        with a sign where some are negative.
        """
        for tick in _ticks(self.low, self.high):
            number = f"{tick:g}"
            if self.low < 0.0 < tick:
                number = f"+{number}"
            yield _text(self.x(tick), self.bottom + 14, number, "soft mid")
        middle = (self.left + self.right) / 2
        yield _text(middle, self.bottom + 30, unit, "soft mid")


def _ticks(low: float, high: float) -> Iterator[float]:
    """Round numbers between two ends, three to six of them."""
    raw = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(raw))
    steps = [power * factor for factor in (1.0, 2.0, 5.0, 10.0)]
    step = next(step for step in steps if step >= raw)
    first = math.ceil(low / step)
    last = math.floor(high / step)
    for number in range(first, last + 1):
        yield round(number * step, 12)


def _room(names: Iterable[str]) -> float:
    """Room to the left of a scale for the names of its rows."""
    letters = max(map(len, names), default=0)
    width = min(_LETTER * letters, _LONGEST)
    return max(_LEFT, width + 10.0)


def _name(y: float, name: str) -> str:
    """Name of a row; one that is too long for its room is drawn narrower, not cut."""
    drawn = _text(0, y, name)
    narrow = f'<text textLength="{_LONGEST:g}" lengthAdjust="spacingAndGlyphs"'
    if _LETTER * len(name) > _LONGEST:
        return drawn.replace("<text", narrow, 1)
    return drawn


def _largest(values: Iterable[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return max(finite, default=0.0)


def _drawing(parts: Iterable[str], title: str, height: float) -> str:
    words = spelled(title)
    content = "".join(parts)
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {height:g}" role="group" '
        f'aria-label="{words}"><title>{words}</title>'
        f"{content}</svg>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _dot(x: float, y: float, kind: str) -> str:
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="4.5"/>'


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    named = ""
    if kind:
        named = f' class="{kind}"'
    return f'<text{named} x="{x:.1f}" y="{y:.1f}">{spelled(text)}</text>'
