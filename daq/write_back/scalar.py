"""One number in the text of a controller's document, and the same text with other numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from daq.errors import ControllerUnfit
from daq.write_back.gain_spelling import IntegerStyle, spell

KeyPath = tuple[str, ...]
Leaves = Mapping[KeyPath, str]
"""Every value of a document by its path, as one parser sees it."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """One number in the text.

    Attributes:
        key: where it is, as the cell configuration names it.
        value: the number.
        text: how it is written.
        start, end: its characters in the text, quotes outside.
        line: from 1.
        integer: what integers the document allows there, None where any decimal number may stand.
    """

    key: str
    value: float
    text: str
    start: int
    end: int
    line: int
    integer: IntegerStyle | None = None

    def read(self, text: str) -> float:
        """The number that another text would stand for in this place."""
        return float(text) if self.integer is None else float(self.integer.read(text))

    def spell(self, value: float, std: float) -> str:
        """A number as it is written in this place.

        Args:
            value: finite, not zero [unit of the document].
            std: its standard deviation; what rounding to an integer may cost at most.

        Raises:
            ControllerUnfit: only integers may stand here, and none is near enough or in range.
        """
        if self.integer is None:
            return spell(value, std, self.text)
        rounded = round(value)
        if not self.integer.lowest <= rounded <= self.integer.highest:
            raise ControllerUnfit(
                self.key,
                found=f"{value:.6g} for an integer of {self.integer.lowest} to {self.integer.highest}",
                expected="a gain that fits",
                remedy="check the factor in `controller.gains` of the cell configuration; nothing was written",
            )
        if rounded == 0 or 0 < std < abs(rounded - value):
            raise ControllerUnfit(
                self.key,
                found=f"{value:.6g} ± {std:.2g}, which the integer {rounded} does not tell",
                expected="a rounding below σ",
                remedy="this object is too coarse: write the gain to another one, or in a finer unit by its factor in "
                "`controller.gains`; nothing was written",
            )
        return self.integer.spell(rounded, self.text)


@dataclass(frozen=True, slots=True)
class Respelling:
    """A gain as it would stand in a document whose unit may be another.

    Attributes:
        old, new: gain there now, and as it would be read back from the new text [gain unit].
        spelling: the new number as it would stand in the document; that of now where it is the same number.
    """

    old: float
    new: float
    spelling: str


def respell(scalar: Scalar, value: float, std: float, factor: float = 1.0) -> Respelling:
    """Put a gain in the place of a number.

    Args:
        scalar: the number now.
        value: gain, finite and not zero [gain unit].
        std: its standard deviation [gain unit].
        factor: number in the document = gain × factor.

    Raises:
        ControllerUnfit: see `Scalar.spell`.
    """
    spelling = scalar.spell(factor * value, abs(factor) * std)
    number = scalar.read(spelling)
    if number == scalar.value:
        spelling = scalar.text  # the same number in the human's own spelling is no change
    return Respelling(scalar.value / factor, number / factor, spelling)


def spliced(text: str, scalars: Sequence[Scalar], spelling: Mapping[str, str]) -> str:
    """The same text with other numbers in some places, each named by its key."""
    for scalar in sorted(scalars, key=lambda s: s.start, reverse=True):
        text = text[: scalar.start] + spelling[scalar.key] + text[scalar.end :]
    return text


def check_leaves(
    name: str, old: Leaves, new: Leaves, targets: Mapping[KeyPath, str], strip: Callable[[str], str] = str
) -> None:
    """Refuse unless a document differs from what it was in the named numbers alone, for one parser.

    Args:
        name: of the document.
        old, new: its leaves before and after.
        targets: the new number, as text, by its path.
        strip: takes off what a reader of that format overlooks around a number.

    Raises:
        ControllerUnfit: it differs in more, or in less.
    """
    others = [path for path in old.keys() | new.keys() if path not in targets and old.get(path) != new.get(path)]
    wrong = [path for path, number in targets.items() if strip(new.get(path, "")) != number]
    if others or wrong:
        raise ControllerUnfit(
            name,
            found=f"another value at {', '.join(sorted('.'.join(path) for path in [*wrong, *others]))}",
            expected="the new gains and nothing else changed",
            remedy="nothing was written; write these gains as plain numbers in the file",
        )


def check_text(name: str, text: str, expected: str) -> None:
    """Refuse a text that is not the one that was worked out: comments, order and spacing are seen here alone.

    Raises:
        ControllerUnfit: they differ.
    """
    if text != expected:
        at = next(
            (i for i, (a, b) in enumerate(zip(text, expected, strict=False)) if a != b), min(map(len, (text, expected)))
        )
        raise ControllerUnfit(
            name,
            found=f"other characters on line {text.count(chr(10), 0, at) + 1} than were meant",
            expected="the new gains and nothing else changed",
            remedy="nothing was written; look at a new dry run",
        )


def unfit(
    name: str, key: str, found: str, remedy: str, expected: str = "one decimal number of its own"
) -> ControllerUnfit:
    """The error for a place that holds no number that can be changed on its own."""
    return ControllerUnfit(f"{name}: {key}", found=found, expected=expected, remedy=f"{remedy}; nothing was written")


CORRECT_KEY = "correct `controller.gains` of the cell configuration"
