"""The demo cell with its axes on two buses, as text of a cell file."""

from __future__ import annotations

import re

LEFT = (1, 2, 3)
RIGHT = (4, 5, 6)


def on_two_buses(text: str, interface: str, left: str, right: str) -> str:
    """A cell file of one bus and nodes 1 to 6 with two:
    axes 1 to 3 on the left one, 4 to 6 on the right one.

    Args:
        text: of the cell file.
        interface: of both.
        left, right: their channels.
    """
    buses = "".join(
        f"  - {{name: {name}, interface: {interface}, channel: {channel}}}\n"
        for name, channel in (("left", left), ("right", right))
    )
    text = re.sub(r"bus:\n(  .*\n)+", f"bus:\n{buses}", text, count=1)
    return re.sub(
        r"( +)node_id: (\d)\n",
        lambda found: f"{found[0]}{found[1]}bus: {'left' if int(found[2]) in LEFT else 'right'}\n",
        text,
    )
