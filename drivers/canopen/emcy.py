"""Error codes of EMCY and 603Fh in words.

The texts are those of CiA 301 and CiA 402-2 (emcy.txt). Other codes are described by their class:
upper byte, then upper digit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import DriverError
from drivers.profiles.profile import ObjectEntry

if TYPE_CHECKING:
    from drivers.canopen.sdo import ObjectAccess

_LINES = Path(__file__).with_name("emcy.txt").read_text(encoding="utf-8").splitlines()
_TEXTS = dict(line.split(" ", maxsplit=1) for line in _LINES if not line.startswith("#"))
CODES = {int(digits, 16): text for digits, text in _TEXTS.items() if len(digits) == 4}
"""Text of each code that the two standards name."""


_NO_ERROR = 0x00  #: Upper byte of the codes that report that there is no error, or none any more
_REMEDIES = {
    0x2: "check motor cable and windings for shorts, and the load; let the drive cool",
    0x3: "check the supply voltage and the brake resistor; use slower moves",
    0x4: "let the drive and the motor cool; check fan and load",
    0x5: "switch the drive off and on; if it comes again, exchange the drive",
    0x6: "switch the drive off and on; if it comes again, check its parameters and firmware",
    0x7: "check the plugs and cables of encoder and brake",
    0x8: "check the bus's cable, termination and load",
    0x9: "check the device that the drive watches from outside, and its cable",
}
"""First remedy of each class of CiA 301, by its digit."""


@dataclass(frozen=True, slots=True)
class ErrorCode:
    """An error code in words."""

    code: int  #: of EMCY or 603Fh
    hex: str  #: as manuals write it, such as 8611h
    text: str  #: meaning
    remedy: str  #: what to try first


def explain(code: int) -> ErrorCode:
    """Return meaning and first remedy of an error code of 16 bits."""
    return ErrorCode(code, f"{code:04X}h", describe_error_code(code), remedy_of(code))


def remedy_of(code: int) -> str:
    """Return what to try first for an error code; the drive's manual says more."""
    if code >> 8 == _NO_ERROR:
        return "nothing: the drive reports no error"
    if code >> 8 in (0x84, 0x85, 0x86):
        first = "check brake, load and collision; use slower moves"
    else:
        first = ""
    first = first or _REMEDIES.get(code >> 12, "see the drive's manual")
    return f"{first}; then reset the fault with `CanopenNetwork.reset_faults`"


def describe_error_code(code: int) -> str:
    """Describe an error code of 16 bits; for a code that is in no standard, its class."""
    if code in CODES:
        return CODES[code]
    if code >= 0xFF00:
        return "device specific, see the drive's manual"
    for mask in (0xFFF0, 0xFF00, 0xF000):
        if code & mask in CODES and code & mask:
            return f"{CODES[code & mask]} (this code is the maker's)"
    return f"{_TEXTS.get(f'{code >> 12:X}', 'reserved')} (this code is the maker's)"


def read_error_code(access: ObjectAccess) -> int:
    """Read the error code of a drive (603Fh); 0 where it names none or does not answer."""
    try:
        return access.read(ObjectEntry(0x603F, 0, 16))
    except DriverError:
        return 0
