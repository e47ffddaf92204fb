"""Find the gains in a device configuration file (CiA 306 DCF).

A number is decimal, or hexadecimal after `0x`. An integer with another zero before it (`010`) is
octal to CiA 306 and decimal to many a tool: it is refused, not guessed.

An object is named by index and subindex, both hexadecimal: `6076`, `2003:01`, `2003sub1`. Its
number is the `ParameterValue` of its section. A data sheet (EDS) has none, and none is put there:
that would be a new line.

In compact storage an array has one section for all its elements: `[2003]` with `CompactSubObj`, the
number of them. The values that differ from the default are in `[2003Value]`, each under its
subindex.
"""

from __future__ import annotations

import configparser
import re
from collections import Counter
from dataclasses import dataclass, field

from daq.errors import ControllerUnfit
from daq.formats.scalar import (
    CORRECT_KEY,
    DECIMAL,
    OCTAL,
    ControllerDocument,
    IntegerStyle,
    KeyPath,
    Scalar,
    Values,
)

_KEY = re.compile(r"(?:0x)?([0-9a-f]{4})h?(?:(?:sub|:)(?:0x)?([0-9a-f]{1,2})h?)?", re.IGNORECASE)
_TITLE = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]+))?")
_CODE = re.compile(r"0|[1-9][0-9]{0,9}|0x[0-9a-f]{1,8}", re.IGNORECASE)
"""The number of a type: Python's int(…, 0) takes underscores, signs and 0b too."""
_VALUE = "parametervalue"
_TYPE = "datatype"
_OBJECT_TYPE = "objecttype"
_VARIABLE = 7
_COMPACT = "compactsubobj"
_INTEGERS = {
    0x02: (8, True),
    0x03: (16, True),
    0x04: (32, True),
    0x10: (24, True),
    0x15: (64, True),
    0x05: (8, False),
    0x06: (16, False),
    0x07: (32, False),
    0x16: (24, False),
    0x1B: (64, False),
}
"""Bits and sign by the number of the type (CiA 301, table of data types)."""
_REALS = (0x08, 0x11)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the number of an object is."""

    described: DcfSection  #: says its type and limits
    values: DcfSection  #: has its number
    entry: str  #: the name of the number there

    @property
    def is_compact(self) -> bool:
        """Whether it is an element of an array in compact storage."""
        return self.values is not self.described


@dataclass(frozen=True, slots=True)
class DcfDocument(ControllerDocument):
    """A DCF as it was read: each byte a character (ISO 8859-1),
    so that nothing is lost in whatever encoding it is.
    """

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`."""
        sections = sections_of(self.text)
        return tuple(self._locate(sections, key) for key in keys)

    def readings(self) -> tuple[Values, Values]:
        """Read with our parser and with configparser."""
        values: dict[KeyPath, str] = {}
        seen = Counter[KeyPath]()
        for section in sections_of(self.text):
            for entry in section.entries:
                seen[section.title, entry.name] += 1
                again = seen[section.title, entry.name]
                name = f"{entry.name} ({again})"
                if again == 1:
                    name = entry.name
                values[section.title, name] = entry.value
        return values, parsed_values(self.name, self.text)

    def path_of(self, key: str) -> KeyPath:
        """Return section and entry of an object's value."""
        place = self._place(sections_of(self.text), key)
        return (place.values.title, place.entry)

    def _place(self, sections: list[DcfSection], key: str) -> _Place:
        match = _KEY.fullmatch(key)
        if match is None:
            remedy = f"{CORRECT_KEY}: 6076, 2003:01 or 2003sub1"
            raise self.unfit(key, "a key that names no object", remedy)
        index = int(match[1], 16)
        subindex = int(match[2] or "0", 16)
        compact = self._compact_place(sections, key, index, subindex)
        if compact is not None:
            return compact
        section = self._section(sections, key, index, subindex, is_named=match[2] is not None)
        return _Place(section, section, _VALUE)

    def _compact_place(
        self, sections: list[DcfSection], key: str, index: int, subindex: int
    ) -> _Place | None:
        """Return where an element of an array in compact storage is;
        None where it has its own section.
        """
        titles = [section.title for section in sections]
        arrays = [section for section in sections if section.title == f"{index:04x}"]
        own_title = f"{index:04x}sub{subindex:x}"
        if subindex == 0 or len(arrays) != 1 or own_title in titles:
            return None
        array = arrays[0]
        entries = {entry.name: entry for entry in array.entries}
        count = self._number(entries, key, _COMPACT, 0)
        if count == 0:
            return None
        if subindex > count:
            found = f"[{array.title}] with CompactSubObj={count}"
            raise self.unfit(key, found, CORRECT_KEY, f"a subindex from 1 to {count}")
        values = [section for section in sections if section.title == f"{array.title}value"]
        if len(values) > 1:
            lines = _lines_text(values)
            found = f"[{array.title}Value] {len(values)} times, on lines {lines}"
            raise self.unfit(key, found, "remove all but one")
        if not values:
            found = f"[{array.title}] in compact storage, without [{array.title}Value]"
            addition = f"[{array.title}Value] with the line `{subindex}=` and the current gain"
            raise self.unfit(key, found, f"give the device's DCF, or add {addition}")
        return _Place(array, values[0], str(subindex))

    def _section(
        self, sections: list[DcfSection], key: str, index: int, subindex: int, *, is_named: bool
    ) -> DcfSection:
        found = [section for section in sections if _object_of(section) == (index, subindex)]
        records = [section for section in found if self._is_record(section, key)]
        if records and not is_named:
            raise self._is_no_variable(records[0], key)
        # CiA 306 gives an array or record its own section, next to that of its subindex 0.
        found = [section for section in found if section not in records]
        if len(found) > 1:
            lines = _lines_text(found)
            raise self.unfit(key, f"it {len(found)} times, on lines {lines}", "remove all but one")
        if not found:
            raise self._no_section(sections, key, index, subindex)
        return found[0]

    def _no_section(
        self, sections: list[DcfSection], key: str, index: int, subindex: int
    ) -> ControllerUnfit:
        titles = [section.title for section in sections]
        subs = [title for title in titles if title.startswith(f"{index:04x}")]
        has = "it does not have this index at all"
        if subs:
            has = f"it has {', '.join(subs[:12])}"
        wanted = f"[{index:04x}sub{subindex:x}]"
        if subindex == 0:
            wanted = f"[{index:04x}] or {wanted}"
        return self.unfit(key, f"no section {wanted} ({has})", CORRECT_KEY)

    def _is_record(self, section: DcfSection, key: str) -> bool:
        """Whether a section is that of an array or record, not of one element."""
        if "sub" in section.title:
            return False
        entries = {entry.name: entry for entry in section.entries}
        return self._number(entries, key, _OBJECT_TYPE, _VARIABLE) != _VARIABLE

    def _is_no_variable(self, section: DcfSection, key: str) -> ControllerUnfit:
        found = f"[{section.title}], an array or record"
        return self.unfit(key, found, "name one of its subindices")

    def _locate(self, sections: list[DcfSection], key: str) -> Scalar:
        place = self._place(sections, key)
        section = place.described
        entries = self._entries(section, key)
        if not place.is_compact:
            object_type = self._number(entries, key, _OBJECT_TYPE, _VARIABLE)
            if object_type != _VARIABLE:
                raise self._is_no_variable(section, key)
        entry = self._entries(place.values, key).get(place.entry)
        if entry is None and place.is_compact:
            found = f"[{section.title}Value] without {place.entry}, so the device has its default"
            raise self.unfit(
                key, found, f"add the line `{place.entry}=` with the current gain there"
            )
        if entry is None:
            raise self.unfit(
                key,
                f"[{section.title}] without ParameterValue",
                "a data sheet (EDS) has none: give the device's DCF, or add the line with the "
                "current gain",
            )
        kind = self._number(entries, key, _TYPE, 0)
        where = f"line {entry.line}: {entry.value!r:.60}"
        if kind in (*_REALS, *_INTEGERS) and OCTAL.fullmatch(entry.value):
            raise self.unfit(
                key,
                f"{where}, octal by its leading zero",
                "write the value that is meant without a zero before it",
                "a plain decimal number, or an integer after 0x",
            )
        if kind in _REALS:
            if not DECIMAL.fullmatch(entry.value):
                raise self.unfit(key, f"{where} in a real object", "write a plain decimal number")
            return self.decimal_scalar(key, entry.value, entry.start, entry.line)
        if kind not in _INTEGERS:
            raise self.unfit(
                key,
                f"DataType {kind:#06x} in [{section.title}]",
                "name an integer or a real object",
            )
        style = self._style(entries, key, kind)
        try:
            # By its type: a limit of the file does not make a signed object unsigned.
            value = _style_of_type(kind).read_within(entry.value)
        except ValueError as error:
            raise self.unfit(
                key, where, "write a plain integer, decimal or 0x", "an integer of its type"
            ) from error
        return Scalar(key, float(value), entry.value, entry.start, entry.line, style)

    def _entries(self, section: DcfSection, key: str) -> dict[str, DcfEntry]:
        """Return the entries of a section by name; refuse one that has a name twice."""
        names = Counter(entry.name for entry in section.entries)
        doubled = sorted(name for name, count in names.items() if count > 1)
        if doubled:
            raise self.unfit(
                key, f"{', '.join(doubled)} twice in [{section.title}]", "remove one of them"
            )
        return {entry.name: entry for entry in section.entries}

    def _style(self, entries: dict[str, DcfEntry], key: str, kind: int) -> IntegerStyle:
        """Return the integers of a type within the limits of the file."""
        style = _style_of_type(kind)
        lowest = style.lowest
        highest = style.highest
        low_limit = self._limit(entries, key, "lowlimit", style)
        if low_limit is not None:
            lowest = max(lowest, low_limit)
        high_limit = self._limit(entries, key, "highlimit", style)
        if high_limit is not None:
            highest = min(highest, high_limit)
        return IntegerStyle(style.bits, lowest, highest)

    def _limit(
        self, entries: dict[str, DcfEntry], key: str, name: str, style: IntegerStyle
    ) -> int | None:
        """Return a limit of the file; None where it gives none."""
        entry = entries.get(name)
        if entry is None or not entry.value:
            return None
        try:
            return style.read(entry.value)
        except ValueError as error:
            found = f"line {entry.line}: {entry.value:.60} as {name}"
            raise self.unfit(key, found, "correct the limit", "an integer, or nothing") from error

    def _number(self, entries: dict[str, DcfEntry], key: str, name: str, default: int) -> int:
        entry = entries.get(name)
        if entry is None or not entry.value:
            return default
        if not _CODE.fullmatch(entry.value):
            found = f"line {entry.line}: {entry.value!r:.60}"
            expected = (
                f"{name} in decimal digits without a leading zero, or in hexadecimal "
                "digits after 0x"
            )
            raise self.unfit(key, found, "correct it", expected)
        return int(entry.value, 0)


def dcf_document(content: bytes, name: str) -> DcfDocument:
    """Parse a DCF.

    Raises:
        ControllerUnfit: the bytes are no text, or of an encoding with two bytes a character.
    """
    if b"\0" in content:
        raise ControllerUnfit(
            name,
            found=f"byte {content.index(0)} that is zero",
            expected="a DCF in ASCII, ISO 8859-1 or UTF-8",
            remedy="save it in one of these; nothing was written",
        )
    return DcfDocument(name, content.decode("latin-1"), "latin-1")


_LINE = re.compile(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)")
_SECTION = re.compile(r"\s*\[([^\]]*)\]\s*")
LONGEST_NAME = 1000  #: Characters of a name
_BYTE_ORDER_MARK = "ï»¿"  #: That of UTF-8, each byte a character


@dataclass(frozen=True, slots=True)
class DcfEntry:
    """`name = value`; the place is that of the value."""

    name: str
    value: str
    start: int
    line: int


@dataclass(frozen=True, slots=True)
class DcfSection:
    """The entries under one `[title]`; keys and titles in lower case,
    as CiA 306 ignores the case.
    """

    title: str
    line: int
    entries: list[DcfEntry] = field(default_factory=list)


def sections_of(text: str) -> list[DcfSection]:
    """Split the text into sections; comments and lines other than `name=value` are skipped."""
    sections: list[DcfSection] = []
    for number, line in enumerate(_LINE.finditer(text), start=1):
        written = line[1]
        if number == 1:
            written = written.removeprefix(_BYTE_ORDER_MARK)
        if written.lstrip().startswith(";"):
            continue
        title = _SECTION.fullmatch(written)
        # No regular expression: it would try each blank of a long line as the end of the name.
        name, equals, value = written.partition("=")
        if title is not None:
            sections.append(DcfSection(title[1].strip().lower(), number))
        elif equals and sections:
            start = line.end(1) - len(value.lstrip())
            parsed = DcfEntry(name.strip().lower(), value.strip(), start, number)
            sections[-1].entries.append(parsed)
    return sections


def _style_of_type(kind: int) -> IntegerStyle:
    """Return the integers of a type, which is one of _INTEGERS."""
    bits, signed = _INTEGERS[kind]
    lowest = 0
    highest = (1 << bits) - 1
    if signed:
        highest >>= 1
        lowest = -highest - 1
    return IntegerStyle(bits, lowest, highest)


def _object_of(section: DcfSection) -> tuple[int, int] | None:
    """Return index and subindex of a section: 2003sub1 and 2003sub01 are one object;
    None where it is of no object.
    """
    title = _TITLE.fullmatch(section.title)
    if title is None:
        return None
    subindex = title[2] or "0"
    return int(title[1], 16), int(subindex, 16)


def _lines_text(sections: list[DcfSection]) -> str:
    return " and ".join(str(section.line) for section in sections)


def _require_short_names(file: str, text: str) -> None:
    """Refuse a name that configparser would look through for minutes.

    Its time grows with the square of the blanks in a name; CiA 306 has lines of 255 characters.
    """
    for number, line in enumerate(_LINE.finditer(text), start=1):
        name = line[1].partition("=")[0].strip()
        if len(name) > LONGEST_NAME and not name.startswith(";"):
            raise ControllerUnfit(
                f"{file}:{number}",
                found=f"{len(name)} characters before the first `=` or the end of the line",
                expected=f"at most {LONGEST_NAME} (CiA 306: 255 in a line)",
                remedy="correct the line; nothing was written",
            )


def parsed_values(file: str, text: str) -> dict[KeyPath, str]:
    """Return the values by section and name, as configparser reads them.

    Raises:
        ControllerUnfit: it cannot read them, or a name is too long.
    """
    _require_short_names(file, text)
    parser = configparser.RawConfigParser(
        strict=False,
        allow_no_value=True,
        delimiters=("=",),
        comment_prefixes=(";",),
        empty_lines_in_values=False,
        default_section="\0",
    )
    try:
        parser.read_string(text.removeprefix(_BYTE_ORDER_MARK))
    except (configparser.Error, AttributeError) as error:
        # An indented line goes on with the value above it; without a value, Python before 3.13
        # fails for want of one.
        no_value = isinstance(error, AttributeError)
        why = "an indented line below a name without `=`"
        if not no_value:
            one_line = " ".join(str(error).split())
            why = one_line[:200]
        raise ControllerUnfit(
            file,
            found=f"no DCF ({why})",
            expected="sections of name=value (CiA 306)",
            remedy="correct the file; nothing was written",
        ) from error
    values: dict[KeyPath, str] = {}
    for section in parser.sections():
        title = section.strip().lower()
        for name, value in parser.items(section):
            values[title, name] = value or ""
    return values
