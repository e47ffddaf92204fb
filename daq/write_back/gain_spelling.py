"""How a gain is written into a controller file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

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
