"""Drawings of a certificate as SVG in the page: intervals beside limits, errors before and after, a curve.

They take their colours from the page's style (`daq.report.html`), so that they follow dark mode and paper. A drawing is
`_WIDTH` wide, about that of a phone, so that its text keeps its size there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.report.html import spelled
from ident.arrays import FloatArray

_WIDTH, _ROW, _TOP, _FOOT = 360.0, 25.0, 6.0, 36.0
_LEFT, _RIGHT = 46.0, 84.0  #: Room for the names and for the numbers
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
    earlier: float = math.nan  #: value to compare with, NaN for none


def intervals(rows: Sequence[Interval], title: str, unit: str) -> str:
    """Draw values with their intervals around zero, and the limits of each.

    The scale shows the limits where the values need a tenth of it or more. Else it is the values' own, and arrows at
    both ends say that the limits are beyond.
    """
    reach = _largest([abs(r.value) + r.half for r in rows] + [abs(r.earlier) for r in rows])
    bounds = _largest([abs(bound) for r in rows for bound in (r.lower, r.upper)])
    to_scale = bounds == 0.0 or reach >= 0.1 * bounds
    # Below 0.1 a scale would only magnify noise.
    extent = _ROOM * max(reach, bounds if to_scale else 0.0, 0.1)
    scale = _Scale(-extent, extent, len(rows))
    parts = [*scale.frame(unit), _line(scale.x(0.0), _TOP, scale.x(0.0), scale.bottom, "zero")]
    for number, row in enumerate(rows):
        y = scale.y(number)
        low, high = (scale.x(min(max(bound, -extent), extent)) for bound in (row.lower, row.upper))
        parts.insert(0, f'<rect class="range" x="{low:.1f}" y="{y - 9:.1f}" width="{high - low:.1f}" height="18"/>')
        parts += [
            _line(scale.x(bound), y - 9, scale.x(bound), y + 9, "limit")
            for bound in (row.lower, row.upper)
            if abs(bound) <= extent
        ]
        if math.isfinite(row.earlier):
            parts.append(_diamond(scale.x(row.earlier), y))
        if math.isfinite(row.value):
            parts.append(_line(scale.x(row.value - row.half), y, scale.x(row.value + row.half), y, "bar"))
            parts.append(_dot(scale.x(row.value), y, "dot"))
        parts += [_text(0, y + 4, row.name), _text(_WIDTH, y + 4, row.label, "end")]
    if not to_scale:
        parts += [
            _text(_LEFT, scale.bottom + 30, "◂ limit", "soft"),
            _text(scale.right, scale.bottom + 30, "limit ▸", "soft end"),
        ]
    return _drawing(parts, title, scale.bottom + _FOOT)


def before_after(rows: Sequence[tuple[str, float, float]], title: str, unit: str) -> str:
    """Draw each value before (hollow) and after (full), from zero; NaN for one that is not known."""
    scale = _Scale(0.0, _ROOM * max(_largest([v for _, *both in rows for v in both]), 1e-9), len(rows))
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
        label = " → ".join(f"{value:.1f}" for value in known) or "-"
        parts += [_text(0, y + 4, name), _text(_WIDTH, y + 4, label, "end")]
    return _drawing(parts, title, scale.bottom + _FOOT)


def curve(x: FloatArray, y: FloatArray, half: FloatArray | None, title: str, labels: tuple[str, str]) -> str:
    """Draw y over x with its band y ± half, all of shape (k,); no band where half is None. `labels`: of x and of y."""
    edges = np.concatenate([y] if half is None else [y - half, y + half])
    low, high = min(float(edges.min()), 0.0), max(float(edges.max()), 0.0)
    high = high if high > low else low + 1.0
    across, left, height = _WIDTH - 8.0, 46.0, 140.0

    def right(value: float) -> float:
        return left + (value - float(x[0])) / float(x[-1] - x[0]) * (across - left)

    def down(value: float) -> float:
        return 20.0 + (high - value) / (high - low) * (height - 20.0)

    def place(xs: FloatArray, ys: FloatArray) -> str:
        return " ".join(f"{right(a):.1f},{down(b):.1f}" for a, b in zip(xs.tolist(), ys.tolist(), strict=True))

    parts = [
        _line(left, down(tick), across, down(tick), "zero" if tick == 0.0 else "grid") for tick in _ticks(low, high)
    ]
    parts += [_text(left - 5, down(tick) + 4, f"{tick:g}", "soft end") for tick in _ticks(low, high)]
    for tick in _ticks(float(x[0]), float(x[-1])):
        parts.append(_text(right(tick), height + 16, f"{tick:g}", "soft mid"))
    if half is not None:
        both = place(np.concatenate([x, x[::-1]]), np.concatenate([y + half, (y - half)[::-1]]))
        parts.append(f'<polygon class="band" points="{both}"/>')
    parts.append(f'<polyline class="line" points="{place(x, y)}"/>')
    parts += [_text(0, 12, labels[1], "soft"), _text(across, height + 32, labels[0], "soft end")]
    return _drawing(parts, title, height + 38)


@dataclass(frozen=True, slots=True)
class _Scale:
    """Rows from above, and a scale from left to right."""

    low: float
    high: float
    rows: int

    @property
    def right(self) -> float:
        return _WIDTH - _RIGHT

    @property
    def bottom(self) -> float:
        return _TOP + _ROW * self.rows

    def x(self, value: float) -> float:
        return _LEFT + (value - self.low) / (self.high - self.low) * (self.right - _LEFT)

    def y(self, row: int) -> float:
        return _TOP + _ROW * (row + 0.5)

    def frame(self, unit: str) -> Iterator[str]:
        for tick in _ticks(self.low, self.high):
            yield _line(self.x(tick), _TOP, self.x(tick), self.bottom, "grid")
            yield _text(
                self.x(tick), self.bottom + 14, f"{tick:+g}" if self.low < 0 and tick else f"{tick:g}", "soft mid"
            )
        yield _text((_LEFT + self.right) / 2, self.bottom + 30, unit, "soft mid")


def _ticks(low: float, high: float) -> Iterator[float]:
    """Round numbers between two ends, three to six of them."""
    raw = (high - low) / 4.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= raw)
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        yield round(number * step, 12)


def _largest(values: Iterable[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=0.0)


def _drawing(parts: Iterable[str], title: str, height: float) -> str:
    words = spelled(title)
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {height:g}" role="img" aria-label="{words}"><title>{words}</title>'
        f"{''.join(parts)}</svg>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _dot(x: float, y: float, kind: str) -> str:
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="4.5"/>'


def _diamond(x: float, y: float) -> str:
    return f'<path class="hollow" d="M{x:.1f} {y - 7:.1f}l6 7l-6 7l-6-7z"/>'


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    named = f' class="{kind}"' if kind else ""
    return f'<text{named} x="{x:.1f}" y="{y:.1f}">{spelled(text)}</text>'
