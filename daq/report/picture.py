"""Shared by the pictures of matplotlib: size, colours, rendering.

No pyplot, which keeps figures in a global list.
"""

from __future__ import annotations

import io
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito, "Color Universal Design" (2008): distinct to colour-blind readers and in grey
# print.
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
BLACK = "#000000"
GREY = "#7F7F7F"

#: Quantity of a joint, by its unit: N where it is prismatic
QUANTITY = {"Nm": "torque", "N": "force"}

DPI = 130
_PANEL_IN = (5.6, 2.0)
_TITLE_AND_LEGEND_IN = 1.1

# Without a home folder that can be written, matplotlib takes a temporary one, and says so in two
# lines that ask for nothing.
logging.getLogger("matplotlib").setLevel(logging.ERROR)


def panels(count: int, columns: int, title: str) -> tuple[Figure, list[Axes]]:
    """Make a figure of `count` small multiples that share their horizontal axis,
    filled row by row.
    """
    columns = min(columns, count)
    rows = -(-count // columns)
    panel_width_in, panel_height_in = _PANEL_IN
    width_in = max(panel_width_in * columns, 7.5)
    height_in = panel_height_in * rows + _TITLE_AND_LEGEND_IN
    figure = _figure(title, width_in, height_in)
    places: list[Axes] = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    for empty in places[count:]:
        empty.set_axis_off()
    for position, place in enumerate(places[:count]):
        _plain(place)
        # In a last row that is not full, the panel above the gap is the lowest of its column.
        place.tick_params(labelbottom=position >= count - columns)
    return figure, places[:count]


def single(title: str, height_in: float) -> tuple[Figure, Axes]:
    """Make a figure of one wide panel, of a height in inches."""
    figure = _figure(title, 2 * _PANEL_IN[0], height_in + _TITLE_AND_LEGEND_IN)
    place = figure.subplots()
    _plain(place)
    return figure, place


def _figure(title: str, width_in: float, height_in: float) -> Figure:
    # A fit that draws nothing does not wait for matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    return figure


def legend_below(figure: Figure, *places: Axes) -> None:
    """Draw one legend for all panels, outside of them, so that it covers no data."""
    pairs: list[tuple[Artist, str]] = []
    for place in places:
        handles, labels = place.get_legend_handles_labels()
        pairs += zip(handles, labels, strict=True)
    named = {label: handle for handle, label in reversed(pairs)}
    figure.legend(
        list(reversed(named.values())),
        list(reversed(named)),
        loc="outside lower center",
        ncols=len(named),
        frameon=False,
        fontsize=9,
        markerscale=1.5,
    )


def render(figure: Figure, kind: str = "png") -> bytes:
    """Return the content of a file, png or svg; the same figure gives the same bytes:
    no time, no random names.
    """
    from matplotlib import rc_context  # noqa: PLC0415

    drawn = io.BytesIO()
    with rc_context({"svg.hashsalt": "drivegain"}):
        figure.savefig(
            drawn, format=kind, dpi=DPI, metadata={"Date" if kind == "svg" else "Software": None}
        )
    return drawn.getvalue()


def unformatted(text: str) -> str:
    """Escape dollar signs, which would begin a formula in matplotlib."""
    return text.replace("$", r"\$")


def _plain(place: Axes) -> None:
    place.grid(visible=True, color="#DDDDDD", linewidth=0.6)
    place.set_axisbelow(True)
    place.spines[["top", "right"]].set_visible(False)
    place.tick_params(labelsize=8)
