"""One number in the text of a controller's document, and the same text with other numbers."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from daq.errors import ControllerUnfit

# How a gain is written into a controller file.


_EXPONENT = re.compile(r"([eE])[-+]?([0-9]+)$")
_INTEGER = re.compile(r"-?(?:0|[1-9][0-9]*)|0[xX][0-9a-fA-F]+")


@dataclass(frozen=True, slots=True)
class IntegerStyle:
    """Integers of a type in decimal, or in hexadecimal as two's complement.

    Attributes:
        bits: of the type.
        lowest, highest: what is allowed.
    """

    bits: int
    lowest: int
    highest: int

    def read(self, text: str) -> int:
        """The integer.

        Raises:
            ValueError: it is none, is ambiguous (a leading zero is octal to CiA 306), or has too many bits.
        """
        if not _INTEGER.fullmatch(text):
            raise ValueError(text)
        value = int(text, 0)
        if text[:2] in ("0x", "0X") and self.lowest < 0 and value >> (self.bits - 1) == 1:
            value -= 1 << self.bits
        if not -(1 << (self.bits - 1)) <= value < 1 << self.bits:
            raise ValueError(text)
        return value

    def spell(self, value: int, like: str) -> str:
        """As text; in hexadecimal with at least as many digits, and in that case, where `like` is."""
        if like[:2] not in ("0x", "0X"):
            return str(value)
        digits = f"{value % (1 << self.bits):0{len(like) - 2}x}"
        return like[:2] + (digits if re.search("[a-f]", like[2:]) else digits.upper())


def spell(value: float, std: float, like: str = "") -> str:
    """A gain as text: two digits beyond the first digit of σ, at least five significant, no more than a float has.

    The text has a point always, and its exponent a sign, so that no reader takes it for an integer or for text
    (YAML 1.1 knows no 1e3).

    Args:
        value: not zero [unit].
        std: standard deviation [unit].
        like: how the number that it replaces is written. Its exponent, its plus and at least as many decimals are
            kept: they are the habit of whoever reads the file.
    """
    exponent = _EXPONENT.search(like)
    magnitude = math.floor(math.log10(abs(value)))
    decimals = 4 - magnitude
    if std > 0:
        decimals = max(decimals, 2 - math.floor(math.log10(std)))
    _, _, fraction = like.removesuffix(exponent[0] if exponent else "").partition(".")
    if exponent is None:
        decimals = max(decimals, len(fraction))
    decimals = min(decimals, 16 - magnitude)
    plus = "+" if like.startswith("+") else "-"
    if exponent or magnitude < -5 or magnitude > 12:
        mantissa, _, power = f"{value:{plus}.{max(decimals + magnitude, 1)}e}".partition("e")
        mark, digits = exponent.groups() if exponent else ("e", "00")
        return f"{mantissa}{mark}{power[0]}{abs(int(power)):0{len(digits)}d}"
    return f"{value:{plus}.{max(decimals, 1)}f}"


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
class RewrittenGain:
    """A gain as it would stand in a document whose unit may be another.

    Attributes:
        old, new: gain there now, and as it would be read back from the new text [gain unit].
        spelling: the new number as it would stand in the document; that of now where it is the same number.
    """

    old: float
    new: float
    spelling: str


def rewrite_gain(scalar: Scalar, value: float, std: float, factor: float = 1.0) -> RewrittenGain:
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
    return RewrittenGain(scalar.value / factor, number / factor, spelling)


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


# A controller's file in UTF-8 whose numbers are named by dotted paths, as YAML and JSON have them.


@dataclass(frozen=True, slots=True)
class DottedDocument(ABC):
    """A file as it was read; a number is named by its dotted path (`drives.J1.gain`, `gains.0`).

    Attributes:
        name: what to call it in messages.
        text: all of it, a byte order mark and the line ends included.
    """

    name: str
    text: str

    @property
    def content(self) -> bytes:
        """The text as it stands in the file."""
        return self.text.encode()

    @abstractmethod
    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """Find the numbers at some dotted paths, in their order.

        Raises:
            ControllerUnfit: the file does not parse, or a path leads to no number that can be changed on its own.
        """

    @abstractmethod
    def readings(self) -> tuple[Leaves, Leaves]:
        """The leaves as two parsers that have nothing in common see them.

        Raises:
            ControllerUnfit: one of them cannot read it.
        """

    def with_values(self, spelling: Mapping[str, str]) -> Self:
        """The same text with other numbers at some dotted paths, read back by both parsers.

        Args:
            spelling: the new number, as text, by dotted path.

        Raises:
            ControllerUnfit: as `locate`, or the new text does not say what was meant and nothing else.
        """
        changed = type(self)(self.name, spliced(self.text, self.locate(tuple(spelling)), spelling))
        changed.check_against(self, spelling)
        return changed

    def check_against(self, before: Self, spelling: Mapping[str, str]) -> None:
        """Refuse unless this file differs from `before` in the named numbers alone, for both parsers.

        Raises:
            ControllerUnfit: it differs in more, or in less.
        """
        targets: dict[KeyPath, str] = {tuple(key.split(".")): number for key, number in spelling.items()}
        for old, new in zip(before.readings(), self.readings(), strict=True):
            check_leaves(self.name, old, new, targets)
        check_text(self.name, self.text, spliced(before.text, before.locate(tuple(spelling)), spelling))


def utf8(content: bytes, name: str, kind: str) -> str:
    """The text of a file.

    Args:
        content: of the file.
        name: what to call it in messages.
        kind: what it should be.

    Raises:
        ControllerUnfit: it is not UTF-8.
    """
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise ControllerUnfit(
            name,
            found=f"byte {error.start} that is not UTF-8",
            expected=f"{kind} in UTF-8",
            remedy="save the file as UTF-8; nothing was written",
        ) from error
