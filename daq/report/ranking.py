"""The candidates of one turn beside each other: what each would take off the error of moves left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.report.picture import BLUE, GREY, ORANGE, grid, legend_below, save_png, unformatted

_BAR_IN = 0.32
_PASSED, _RIVAL, _CLOSED = "passes every gate", "not told from the best", "a gate is closed"
_LOOK = {_PASSED: (BLUE, ""), _RIVAL: (ORANGE, "//"), _CLOSED: (GREY, "")}
"""Colour and hatch; hatched, so that grey print tells them too."""


@dataclass(frozen=True, slots=True)
class Bar:
    """One candidate.

    Attributes:
        name: effect and axis.
        fall: of the whole squared error on left-out moves, in units of the noise.
        passed: every gate.
        rival: not told from the one that was added (or, where none was, from the best).
    """

    name: str
    fall: float
    passed: bool
    rival: bool


def plot_ranking(path: Path | None, bars: Sequence[Bar], *, title: str) -> bytes:
    """Draw candidates from the best down; rivals of the best are marked.

    Args:
        path: of the PNG; None where its bytes alone are wanted.
        bars: the best first, at least one.
        title: says which turn it is.

    Returns:
        the PNG.

    Raises:
        OSError: from the file system.
    """
    figure, ((place,),) = grid(1, (1.0,), unformatted(title), height_in=_BAR_IN * len(bars))
    for label, (colour, hatch) in _LOOK.items():
        rows = [row for row, bar in enumerate(bars) if _kind(bar) == label]
        if rows:
            place.barh(
                rows, [bars[row].fall for row in rows], color=colour, hatch=hatch, edgecolor="white", label=label
            )
    place.set_yticks(range(len(bars)), [unformatted(bar.name) for bar in bars])
    place.invert_yaxis()
    place.set_xlabel("fall of the squared error on moves left out [noise variances]", fontsize=8)
    legend_below(figure, place)
    return save_png(figure, path)


def _kind(bar: Bar) -> str:
    if bar.rival:
        return _RIVAL
    return _PASSED if bar.passed else _CLOSED
