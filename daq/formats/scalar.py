"""One number in the text of a controller's file, and the base class of all formats.

A format finds the numbers (`locate`) and reads the text with its parsers (`readings`). The rest is
the same for every format: only the characters of the named numbers are replaced, and the new text
is read back and compared.
"""

from __future__ import annotations

import difflib
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

from daq.errors import ControllerUnfit

_EXPONENT = re.compile(r"([eE])[-+]?([0-9]+)$")
_INTEGER = re.compile(r"-?(?:0|[1-9][0-9]*)|0[xX][0-9a-fA-F]+")
DECIMAL = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
#: To CiA 306 and YAML 1.1; a decimal number to YAML 1.2 and many a tool
OCTAL = re.compile(r"[-+]?0[0-9]+")


@dataclass(frozen=True, slots=True)
class IntegerStyle:
    """Integers of a type in decimal, or in hexadecimal as two's complement."""

    bits: int  #: of the type
    lowest: int  #: lowest value
    highest: int  #: highest value

    def read(self, text: str) -> int:
        """Parse an integer.

        Raises:
            ValueError: it is none, is ambiguous (a leading zero is octal to CiA 306), or has too
                many bits.
        """
        if not _INTEGER.fullmatch(text):
            raise ValueError(text)
        value = int(text, 0)
        values = 1 << self.bits
        half = values >> 1
        is_hexadecimal = text[:2] in ("0x", "0X")
        if is_hexadecimal and self.lowest < 0 and half <= value < values:
            value -= values
        if not -half <= value < values:
            raise ValueError(text)
        return value

    def read_within(self, text: str) -> int:
        """Parse an integer from the lowest to the highest value.

        Raises:
            ValueError: as `read`, or it is none of these.
        """
        value = self.read(text)
        if not self.lowest <= value <= self.highest:
            raise ValueError(text)
        return value

    def spell(self, value: int, like: str) -> str:
        """Format an integer; in hexadecimal where `like` is,
        with at least as many digits and in the same case.
        """
        prefix = like[:2]
        digits_like = like[2:]
        if prefix not in ("0x", "0X"):
            return str(value)
        unsigned = value % (1 << self.bits)
        digits = f"{unsigned:0{len(digits_like)}x}"
        if not re.search("[a-f]", digits_like):
            digits = digits.upper()
        return prefix + digits


def spell(value: float, std: float, like: str = "") -> str:
    """Format a gain: two digits beyond the first digit of σ, at least five significant,
    no more than a float has.

    The text always has a point, and its exponent a sign: no reader takes it for an integer or for
    text (YAML 1.1 has no 1e3).

    Args:
        value: not zero [unit].
        std: standard deviation [unit].
        like: text of the number that it replaces. Its exponent, its plus and at least as many
            decimals stay, as the file's readers are used to them.
    """
    mantissa_like = like
    mark = "e"
    least_digits = 2
    exponent = _EXPONENT.search(like)
    if exponent is not None:
        mantissa_like = like.removesuffix(exponent[0])
        mark, digits = exponent.groups()
        least_digits = len(digits)
    magnitude = math.floor(math.log10(abs(value)))
    decimals = 4 - magnitude
    if std > 0:
        decimals = max(decimals, 2 - math.floor(math.log10(std)))
    if exponent is None:
        _, _, fraction = mantissa_like.partition(".")
        decimals = max(decimals, len(fraction))
    decimals = min(decimals, 16 - magnitude)
    plus = "-"
    if like.startswith("+"):
        plus = "+"
    if exponent or magnitude < -5 or magnitude > 12:
        decimals = max(decimals + magnitude, 1)
        mantissa, _, power = f"{value:{plus}.{decimals}e}".partition("e")
        sign = power[0]
        return f"{mantissa}{mark}{sign}{abs(int(power)):0{least_digits}d}"
    decimals = max(decimals, 1)
    return f"{value:{plus}.{decimals}f}"


KeyPath = tuple[str, ...]
Values = Mapping[KeyPath, str]  #: Every value of a document by its path, as one parser sees it


@dataclass(frozen=True, slots=True)
class Scalar:
    """One number in the text."""

    key: str  #: its key in the cell configuration
    value: float  #: the number
    text: str  #: the number as it is written
    start: int  #: its first character in the text, inside any quotes
    line: int  #: from 1
    #: Style of the integers that are allowed there; None where any decimal number is.
    integer: IntegerStyle | None = None

    @property
    def end(self) -> int:
        """The character after its last one."""
        return self.start + len(self.text)

    def read(self, text: str) -> float:
        """Return the number that another text would mean in this place."""
        if self.integer is None:
            return float(text)
        return float(self.integer.read(text))

    def spell(self, value: float, std: float) -> str:
        """Format a number for this place: finite, not zero;
        σ bounds the error of rounding to an integer.

        Raises:
            ControllerUnfit: only integers are allowed here, and none is near enough or in range.
        """
        if self.integer is None:
            return spell(value, std, self.text)
        rounded = round(value)
        lowest = self.integer.lowest
        highest = self.integer.highest
        if not lowest <= rounded <= highest:
            raise ControllerUnfit(
                self.key,
                found=f"{value:.6g} for an integer of {lowest} to {highest}",
                expected="a gain that fits",
                remedy="check the factor in `controller.gains` of the cell configuration; nothing "
                "was written",
            )
        if rounded == 0 or 0 < std < abs(rounded - value):
            raise ControllerUnfit(
                self.key,
                found=f"{value:.6g} ± {std:.2g}, which the integer {rounded} does not represent",
                expected="a rounding below σ",
                remedy="this object is too coarse: write the gain to another one, or in a finer "
                "unit by its factor in `controller.gains`; nothing was written",
            )
        return self.integer.spell(rounded, self.text)


@dataclass(frozen=True, slots=True)
class RewrittenGain:
    """A gain in a document, whose unit may be another."""

    current_gain: float  #: gain that the file has there [unit]
    new: float  #: gain as it would be read back from the new text [unit]
    spelling: str  #: the new number in the document; unchanged text where it is the same number


def rewrite_gain(scalar: Scalar, value: float, std: float, factor: float = 1.0) -> RewrittenGain:
    """Put a gain in the place of a number;
    gain, finite and not zero, × factor = number in the document.

    Raises:
        ControllerUnfit: see `Scalar.spell`.
    """
    spelling = scalar.spell(factor * value, abs(factor) * std)
    number = scalar.read(spelling)
    if number == scalar.value:
        spelling = scalar.text  # the same number in another spelling is no change
    return RewrittenGain(scalar.value / factor, number / factor, spelling)


def dotted_paths(key: str, paths: Collection[KeyPath]) -> tuple[KeyPath, ...]:
    """Return every path in a file that reads as a dotted key:
    names of the file may have dots themselves.

    Args:
        key: such as `ros__parameters.gains.joint1`.
        paths: of all values of the file.

    Returns:
        the key split at every dot where no path reads so; more than one path where the key is
        ambiguous.
    """
    found = tuple(path for path in paths if ".".join(path) == key)
    return found or (tuple(key.split(".")),)


@dataclass(frozen=True, slots=True)
class ControllerDocument(ABC):
    """A controller's file as it was read."""

    name: str  #: of the file, for messages
    text: str  #: all of it, a byte order mark and the line ends included
    encoding: str = "utf-8"  #: of the file

    @property
    def content(self) -> bytes:
        """The text as bytes of the file."""
        return self.text.encode(self.encoding)

    @abstractmethod
    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """Find the numbers of some keys, in their order.

        Raises:
            ControllerUnfit: the file does not parse, or a key leads to no number that can be
                changed on its own.
        """

    @abstractmethod
    def readings(self) -> tuple[Values, ...]:
        """Return the values as each parser of the format reads them.

        Two parsers should share no code.

        Raises:
            ControllerUnfit: a parser cannot read the text.
        """

    def first_reading(self) -> Values:
        """Return the values as the first parser of `readings` reads them."""
        return self.readings()[0]

    def unfit(
        self, key: str, found: str, remedy: str, expected: str = "one decimal number of its own"
    ) -> ControllerUnfit:
        """Make the error for a place that holds no number that can be changed on its own."""
        place = f"{self.name}: {key}"
        remedy = f"{remedy}; nothing was written"
        return ControllerUnfit(place, found=found, expected=expected, remedy=remedy)

    def lacking(self, key: str, found: str) -> ControllerUnfit:
        """Make the error for a dotted key that the file lacks; it names the nearest one there is.

        Where names of the file have dots, what was found at one step says little.
        """
        names = [".".join(path) for path in _paths(self)]
        nearest = difflib.get_close_matches(key, names, n=1)
        remedy = CORRECT_KEY
        if nearest:
            remedy = f"{CORRECT_KEY}: the nearest key is {nearest[0]}"
        return self.unfit(key, found, remedy)

    def decimal_scalar(self, key: str, text: str, start: int, line: int) -> Scalar:
        """Return a decimal number of the text.

        Raises:
            ControllerUnfit: it is beyond the numbers that a computer holds (1e400).
        """
        value = float(text)
        if not math.isfinite(value):
            found = f"line {line}: {text:.60}, beyond every number of a computer"
            raise self.unfit(key, found, "correct the number")
        return Scalar(key, value, text, start, line)

    def path_of(self, key: str) -> KeyPath:
        """Return the path of a key's number among the values;
        here a dotted one (`drives.J1.gain`, `gains.0`).

        Raises:
            ControllerUnfit: several places of the file read as this key.
        """
        found = dotted_paths(key, _paths(self))
        if len(found) > 1:
            places = " and ".join(" / ".join(path) for path in found)
            raise self.unfit(
                key, f"{len(found)} places that read as this key: {places}", "rename one of them"
            )
        return found[0]

    def number(self, value: str) -> str:
        """Return the number in a value, without what readers of the format ignore around it."""
        return value

    def with_values(self, spelling: Mapping[str, str]) -> Self:
        """Replace some numbers, each by the text for its key,
        and check the result with `check_against`.

        Raises:
            ControllerUnfit: as `locate`, or the new text has another change than these.
        """
        scalars = self.locate(tuple(spelling))
        changed = replace(self, text=_spliced(self.text, scalars, spelling))
        changed.check_against(self, spelling)
        return changed

    def check_against(self, before: Self, spelling: Mapping[str, str]) -> None:
        """Refuse unless this file differs from `before` in the named numbers alone,
        for every parser and as text.

        Raises:
            ControllerUnfit: it differs in more, or in less.
        """
        targets = {before.path_of(key): number for key, number in spelling.items()}
        for old, new in zip(before.readings(), self.readings(), strict=True):
            others = (old.keys() | new.keys()) - targets.keys()
            wrong = [path for path in others if old.get(path) != new.get(path)]
            for path, number in targets.items():
                written = self.number(new.get(path, ""))
                if written != number:
                    wrong.append(path)
            if wrong:
                places = sorted(".".join(path) for path in wrong)
                raise ControllerUnfit(
                    self.name,
                    found=f"another value at {', '.join(places)}",
                    expected="the new gains and nothing else changed",
                    remedy="nothing was written; write these gains as plain numbers in the file",
                )
        # Comments, order and spacing are compared here alone.
        scalars = before.locate(tuple(spelling))
        expected = _spliced(before.text, scalars, spelling)
        if self.text != expected:
            same = 0
            while self.text[same : same + 1] == expected[same : same + 1]:
                same += 1
            line = 1 + expected.count("\n", 0, same)
            raise ControllerUnfit(
                self.name,
                found=f"other characters on line {line} than planned",
                expected="the new gains and nothing else changed",
                remedy="nothing was written; take a new dry run",
            )


def _spliced(text: str, scalars: Sequence[Scalar], spelling: Mapping[str, str]) -> str:
    """Replace the numbers in some places, each named by its key."""
    for scalar in sorted(scalars, key=lambda s: s.start, reverse=True):
        before = text[: scalar.start]
        behind = text[scalar.end :]
        text = before + spelling[scalar.key] + behind
    return text


CORRECT_KEY = (
    "is this the controller's file? then correct `controller.gains` of the cell configuration"
)


def utf8(content: bytes, name: str, kind: str) -> str:
    """Decode a file.

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


@lru_cache(maxsize=8)  # every key of a file asks for them
def _paths(document: ControllerDocument) -> Collection[KeyPath]:
    """Return the path of every value of a document."""
    return tuple(document.first_reading())
