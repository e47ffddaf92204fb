"""YAML files as people write them, with the numbers meant in places of every kind."""

from __future__ import annotations

from dataclasses import dataclass

from hypothesis import strategies as st

_words = st.text("abcdefghijklmnopqrstuvwxyzé_", min_size=1, max_size=6).filter(
    lambda word: word not in ("y", "n", "no", "on", "off", "yes", "true", "false", "null", "gain")
)
_comments = st.sampled_from(
    ["", "   # data sheet", " # Ü 漢 😀", " #", "          # 33.9 'quoted' {a: b}"]
)
NUMBERS = st.sampled_from(
    ["32.96", "-11.52", "7", "+1.5", "1e3", "2.5E-3", "0.10", ".5", "5.", "00.5"]
)
_quotes = st.sampled_from(["", "", "", "'", '"'])
_gaps = st.sampled_from([" ", "  ", "        "])
_elsewhere = st.sampled_from(
    [
        "",
        "defaults: &d {kp: 1, ti: [1, 2.50]}|uses: *d|merged: {<<: *d, kp: 3}|",
        "text: >-|  gain: 32.96|  folded # no comment|",
        "literal: |+|  32.96|||",
        "? [a, complex key]|: {gain: 32.96, 'quoted key': \"\\u00e9 32.96\"}|",
        "deep: {a: [{b: {c: [[1, 2], {d: 32.96}]}}]}|",
        "date: 2024-01-02|octal: 0o17|hex: 0x20|flag: yes|empty:|tilde: ~|",
        "wide: [1.0,|  2.0,  # of the second||  3.0]|",
    ]
)
"""Before and behind the drives; | is a line end."""


@dataclass(frozen=True)
class Case:
    """A generated file: its text cut where the numbers meant are, and their keys in that order."""

    pieces: tuple[str, ...]
    numbers: tuple[str, ...]
    keys: tuple[str, ...]

    def text(self, numbers: tuple[str, ...]) -> str:
        return "".join(a + b for a, b in zip(self.pieces, (*numbers, ""), strict=True))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    newline = draw(st.sampled_from(["\n", "\r\n"]))
    strategy = st.lists(_words, min_size=1, max_size=4, unique=True)
    axes = draw(strategy)
    sampled = st.sampled_from([1, 2, 4])
    step = " " * draw(sampled)
    head = draw(
        st.sampled_from(
            ["", "\ufeff", "# a human's file", "---", "%YAML 1.1\n---", "title: 'déjà 漢 😀 vu'"]
        )
    )
    around = []
    for _ in range(2):
        around.append(
            draw(_elsewhere).replace("|+|", "\0+|").replace("|", newline).replace("\0", "|")
        )
    if around[1]:
        changed_around = around[1].replace("&d", "&e")
        around[1] = changed_around.replace("*d", "*e").replace(": ", "_2: ", 1)
    else:
        around[1] = ""
    pieces = [head + (newline if head.strip("\ufeff") else "") + around[0] + f"drives:{newline}"]
    numbers: list[str] = []
    keys: list[str] = []
    for axis in axes:
        shape = draw(st.sampled_from(["block", "flow", "list", "anchored", "tagged", "last"]))
        number = draw(NUMBERS)
        quote = draw(_quotes)
        gap = draw(_gaps)
        comment = draw(_comments)
        block = (
            f"{step}{axis}:{newline}{step * 2}gain:{gap}",
            f"{comment}{newline}{step * 2}kp: 32.96{newline}",
        )
        last = (
            f"{step}? {axis}{newline}{step}:{step}gain:{gap}",
            f"{comment}{newline}# {axis}{newline}",
        )
        anchored = (
            f"{step}{axis}: {{kp: 1, gain: &{'x' * (len(keys) + 1)} ",
            f"}}{comment}{newline}",
        )
        tagged = (
            f"{step}{axis}:{newline}{step * 2}gain: !!float{gap}",
            f"{comment}{newline}{newline}",
        )
        flow = (f"{step}{axis}: {{gain:{gap}", f" , kp: 7 }}{comment}{newline}")
        before, after = {
            "block": block,
            "flow": flow,
            "list": (
                f"{step}{axis}:{comment}{newline}{step}- 32.96{newline}{step}-{gap}",
                f"{comment}{newline}",
            ),
            "anchored": anchored,
            "tagged": tagged,
            "last": last,
        }[shape]
        pieces[-1] += before + quote
        pieces.append(quote + after)
        numbers.append(number)
        keys.append(f"drives.{axis}.{'1' if shape == 'list' else 'gain'}")
    pieces[-1] += around[1]
    return Case(tuple(pieces), tuple(numbers), tuple(keys))
