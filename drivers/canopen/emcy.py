"""Error codes of EMCY and 603Fh in words.

The texts are those of CiA 301 and CiA 402-2 (emcy.txt). Other codes are described by their class: upper byte, then
upper digit.
"""

from __future__ import annotations

from pathlib import Path

_LINES = Path(__file__).with_name("emcy.txt").read_text(encoding="utf-8").splitlines()
_TEXTS = {digits: text for digits, _, text in (line.partition(" ") for line in _LINES if not line.startswith("#"))}
CODES = {int(digits, 16): text for digits, text in _TEXTS.items() if len(digits) == 4}
"""Text of each code that the two standards name."""


def describe(code: int) -> str:
    """Describe an error code of 16 bits; for a code that is in no standard, its class."""
    if code in CODES:
        return CODES[code]
    if code >= 0xFF00:
        return "device specific, see the drive's manual"
    for mask in (0xFFF0, 0xFF00, 0xF000):
        if code & mask in CODES and code & mask:
            return f"{CODES[code & mask]} (this code is the maker's)"
    return f"{_TEXTS.get(f'{code >> 12:X}', 'reserved')} (this code is the maker's)"
