"""Data sheets (EDS) that are odd as CiA 306 allows, written from a known object dictionary.

Numbers are decimal, hexadecimal or octal; a default may depend on the node id, on either side of
the plus; objects come in any order, between comments and empty lines; records lack sub-indices;
arrays are written in full or by CompactSubObj, with names of some sub-indices.
"""

from __future__ import annotations

from dataclasses import dataclass

from hypothesis import strategies as st

WIDTHS = {0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32}
"""Bits of the integer types of CiA 301, by their number: signed, then unsigned."""
UNSIGNED = (0x05, 0x06, 0x07)
ACCESS = ("ro", "rw", "wo", "const")
LINE_ENDS = ("\n", "\r\n")
NODE_IDS = st.integers(1, 127)


@dataclass(frozen=True)
class Variable:
    """One variable of the dictionary."""

    name: str  #: empty where the sheet has none
    data_type: int
    access: str
    mappable: bool
    default: int | None  #: without the node id; None has no line
    of_node: bool = False  #: whether the node id is added to the default


@dataclass(frozen=True)
class Entry:
    """One object: a variable, a record or an array, whose variables are by sub-index."""

    name: str
    object_type: int  #: 7 variable, 8 array, 9 record
    variables: dict[int, Variable]
    compact: int = 0  #: elements of an array that is written by CompactSubObj; 0 is written in full


@st.composite
def variables(draw: st.DrawFn, name: str) -> Variable:
    """One integer variable."""
    data_type = draw(st.sampled_from(sorted(WIDTHS)))
    is_unsigned = data_type in UNSIGNED
    of_node = is_unsigned and WIDTHS[data_type] > 8 and draw(st.booleans())
    most = 2 ** (WIDTHS[data_type] - 1) - 1
    least = 0 if is_unsigned else -most - 1
    default: int | None = draw(st.integers(least, most - 127))
    if not of_node:
        default = draw(st.one_of(st.none(), st.just(default)))
    access = draw(st.sampled_from(ACCESS))
    mappable = draw(st.booleans())
    return Variable(name, data_type, access, mappable, default, of_node)


@st.composite
def entries(draw: st.DrawFn, index: int) -> Entry:
    """One object of any type."""
    name = f"Object {index:X}"
    sampled = st.sampled_from((7, 8, 9))
    object_type = draw(sampled)
    if object_type == 7:
        return Entry(name, 7, {0: draw(variables(name))})
    count = Variable("Number of entries", 0x05, "ro", mappable=False, default=9)
    if object_type == 8 and draw(st.booleans()):
        size = draw(st.integers(1, 9))
        element = draw(variables(name))
        named = {}
        names = draw(st.integers(0, size))
        for number in range(1, size + 1):
            if number <= names:
                named[number] = f"Element {number}"
            else:
                named[number] = ""
        elements = {}
        for number, own_name in named.items():
            elements[number] = Variable(
                own_name,
                element.data_type,
                element.access,
                element.mappable,
                element.default,
                element.of_node,
            )
        return Entry(name, 8, elements, compact=size)
    members = {0: count}
    for number in draw(st.sets(st.integers(1, 9), min_size=1)):
        members[number] = draw(variables(f"Member {number} of {index:X}"))
    return Entry(name, object_type, members)


@st.composite
def dictionaries(draw: st.DrawFn) -> dict[int, Entry]:
    """Objects by index."""
    indices = draw(st.sets(st.integers(0x1000, 0x67FF), min_size=1, max_size=5))
    return {index: draw(entries(index)) for index in sorted(indices)}


@st.composite
def sheets(draw: st.DrawFn, dictionary: dict[int, Entry]) -> str:
    """Text of a data sheet with these objects."""
    objects = []
    for index, entry in dictionary.items():
        objects.append(_sections(draw, index, entry))
    lines = ["[FileInfo]", "EDSVersion=4.0", "[DeviceInfo]", "VendorName=; none"]
    for sections in draw(st.permutations(objects)):
        for section in sections:
            sampled = st.sampled_from(([], [""], ["; a comment with [brackets] = and $NODEID"]))
            lines += draw(sampled)
            lines += section
    return draw(st.sampled_from(LINE_ENDS)).join([*lines, ""])


def number(draw: st.DrawFn, value: int) -> str:
    """One spelling of a number: decimal, hexadecimal or, with a leading 0, octal."""
    if value < 0:
        return str(value)
    sampled = st.sampled_from((str(value), f"0x{value:x}", f"0X{value:04X}", f"0{value:o}"))
    return draw(sampled)


def _sections(draw: st.DrawFn, index: int, entry: Entry) -> list[list[str]]:
    sampled = st.sampled_from((f"[{index:04X}]", f"[{index:04x}]"))
    head = draw(sampled)
    if entry.object_type == 7:
        type_lines = draw(st.sampled_from(([], [f"ObjectType={number(draw, 7)}"])))
        first_variable = entry.variables[0]
        return [[head, *_fields(draw, first_variable), *type_lines]]
    lines = [head, f"ParameterName={entry.name}", f"ObjectType={number(draw, entry.object_type)}"]
    if entry.compact:
        element = next(iter(entry.variables.values()))
        fields = [line for line in _fields(draw, element) if not line.startswith("ParameterName")]
        whole = [*lines, f"CompactSubObj={number(draw, entry.compact)}", *fields]
        names = [f"[{index:04X}Name]"]
        named = {one: it.name for one, it in entry.variables.items() if it.name}
        names.append(f"NrOfEntries={len(named)}")
        names += [f"{one}={name}" for one, name in named.items()]
        return [whole, names] if named else [whole]
    sections = [[*lines, f"SubNumber={number(draw, len(entry.variables))}"]]
    for subindex, variable in entry.variables.items():
        name = draw(
            st.sampled_from((f"[{index:04X}sub{subindex:x}]", f"[{index:04X}Sub{subindex:X}]"))
        )
        sections.append([name, *_fields(draw, variable)])
    return sections


def _fields(draw: st.DrawFn, variable: Variable) -> list[str]:
    lines = [
        f"ParameterName={variable.name}",
        f"DataType={number(draw, variable.data_type)}",
        f"AccessType={variable.access}",
        f"PDOMapping={int(variable.mappable)}",
    ]
    if variable.default is None:
        return lines
    value = number(draw, variable.default)
    if variable.of_node:
        sampled = st.sampled_from((f"$NODEID+{value}", f"{value}+$NODEID", f"$NodeID + {value}"))
        value = draw(sampled)
    return [*lines, f"DefaultValue={value}"]
