"""A controller's file in UTF-8 whose numbers are named by dotted paths, as YAML and JSON have them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from daq.errors import ControllerUnfit
from daq.write_back.scalar import KeyPath, Leaves, Scalar, check_leaves, check_text, spliced


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
