"""Controllers' documents in JSON, XML and DCF:
only the numbers meant change, as bytes and as any parser sees them.
"""

from __future__ import annotations

import configparser
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.controller import ControllerFormat
from daq.config.yaml_file import MAX_BYTES
from daq.errors import ControllerUnfit
from daq.formats.dcf_document import DcfDocument
from daq.formats.document import (
    FORMATS,
    comment_behind,
    decode_document,
    format_of,
    read_controller_file,
)
from daq.formats.json_document import JsonDocument
from daq.formats.scalar import ControllerDocument, Scalar, rewrite_gain
from daq.formats.xml_document import XmlDocument
from daq.formats.yaml_document import YamlDocument

EXAMPLES = settings(max_examples=80)
_NUMBERS = [
    "32.96",
    "-11.52",
    "7",
    "0",
    "1e3",
    "2.5E-3",
    "0.10",
    "-0.0",
    "123456789.125",
]
_numbers = st.sampled_from(_NUMBERS)
_magnitudes = st.floats(1e-3, 1e4)
_gains = _magnitudes.flatmap(lambda gain: st.sampled_from([gain, -gain]))
_ends = st.sampled_from(["\n", "\r\n"])
_words = st.text("abcdefghijklmnopqrstuvwxyzéß漢", min_size=1, max_size=5)


def choose(draw: st.DrawFn, *options: str) -> str:
    """Draw one of some texts."""
    return draw(st.sampled_from(options))


@dataclass(frozen=True)
class _Case:
    """A generated file: its text cut where the numbers meant are, their keys,
    and how it is encoded.
    """

    pieces: tuple[str, ...]
    numbers: tuple[str, ...]
    keys: tuple[str, ...]
    encoding: str = "utf-8"

    def content(self, numbers: tuple[str, ...]) -> bytes:
        text = self.pieces[0]
        for number, piece in zip(numbers, self.pieces[1:], strict=True):
            text += number + piece
        return text.encode(self.encoding)


_HOLE = "\0"
"""Placeholder of a number meant while a file is made."""


def _case(text: str, numbers: list[str], keys: list[str], encoding: str = "utf-8") -> _Case:
    pieces = tuple(text.split(_HOLE))
    return _Case(pieces, tuple(numbers), tuple(keys), encoding)


_JSON_TEXTS = (
    "32.96",
    'say "7"',
    "\\",
    "déjà 漢",
    "{a: 1}",
    "\u2028",
)


@st.composite
def _json_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    gap = st.sampled_from(["", " ", "\t", end, f"{end}    "])

    def value(path: tuple[str, ...], depth: int) -> str:
        kinds = ["hole", "number", "word", "text"]
        if depth < 3:
            kinds += ["object", "list"]
        kind = choose(draw, *kinds)
        if kind == "hole" and path:
            numbers.append(draw(_numbers))
            keys.append(".".join(path))
            return _HOLE
        if kind == "object" or not path:
            names = draw(st.lists(_words, max_size=4, unique=True))
            members = [member(path, name, depth) for name in names]
            return "{" + ",".join(members) + "}"
        if kind == "list":
            size = draw(st.integers(0, 3))
            items = []
            for i in range(size):
                before = draw(gap)
                item = value((*path, str(i)), depth + 1)
                items.append(before + item)
            return "[" + ",".join(items) + "]"
        if kind == "text":
            return json.dumps(choose(draw, *_JSON_TEXTS))
        if kind == "word":
            return choose(draw, "true", "null")
        return draw(_numbers)

    def member(path: tuple[str, ...], name: str, depth: int) -> str:
        before = draw(gap)
        is_ascii = draw(st.booleans())
        written = json.dumps(name, ensure_ascii=is_ascii)
        before_colon = draw(gap)
        after_colon = draw(gap)
        inside = value((*path, name), depth + 1)
        behind = draw(gap)
        key = f"{before}{written}{before_colon}"
        return f"{key}:{after_colon}{inside}{behind}"

    head = choose(draw, "", "\ufeff", " ", end)
    root = value((), 0)
    text = head + root + draw(gap)
    return _case(text, numbers, keys)


_XML_NOISE = (
    "",
    " ",
    "<!-- 32.96 <Gain>7</Gain> -->",
    "<?tool keep=1?>",
    "<![CDATA[<7>]]>",
    "&#65;&amp;",
    "é",
)
"""What may be between two elements, besides ends of lines."""


@st.composite
def _xml_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    encoding = choose(draw, "utf-8", "utf-8", "iso-8859-1", "windows-1252")
    names = _words
    if encoding != "utf-8":
        names = st.text("abcdefgéß", min_size=1, max_size=5)
    noise = st.sampled_from([*_XML_NOISE, end, f"{end}  "])

    def number(key: str) -> str:
        numbers.append(draw(_numbers))
        keys.append(key)
        return _HOLE

    def tag() -> str:
        if encoding == "utf-8":
            return choose(draw, "Gain", "ns:Axis", "Ü", "Axis")
        return "Axis"

    def element(path: str, depth: int) -> str:
        parts = []
        used: dict[str, int] = {}
        for _ in range(draw(st.integers(0, 3))):
            name = tag()
            place = used.get(name, 0) + 1
            used[name] = place
            parts.append(draw(noise))
            key = f"{path}/{name}[{place}]"
            parts.append(inner(key, name, depth + 1))
        parts.append(draw(noise))
        return "".join(parts)

    def gain_attribute(path: str) -> str:
        quote = choose(draw, "'", '"')
        space = choose(draw, "", " ")
        before = choose(draw, " ", end)
        hole = number(f"{path}/@gain")
        value = f"{quote}{space}{hole}{space}{quote}"
        return f"{before}gain{space}={space}{value}"

    def inner(path: str, name: str, depth: int) -> str:
        label = draw(names)
        attributes = f" name={quoteattr(label)}"
        if draw(st.booleans()):
            attributes += gain_attribute(path)
        attributes += choose(draw, "", " ", " note='a>b'", f"{end}x='&lt;7'")
        shapes = ["number", "text", "empty"]
        if depth < 3:
            shapes.append("elements")
        shape = choose(draw, *shapes)
        if shape == "empty":
            return f"<{name}{attributes}/>"
        if shape == "number":
            pad = choose(draw, "", " ", end)
            body = f"{pad}{number(path)}{pad}"
        elif shape == "text":
            body = escape(label)
        else:
            body = element(path, depth)
        return f"<{name}{attributes}>{body}</{name}>"

    head = f'<?xml version="1.0" encoding="{encoding}"?>{end}'
    if encoding == "utf-8":
        head = choose(draw, "", "\ufeff", head, f"\ufeff{head}")
    root = f"<Robot xmlns:ns='urn:x'>{element('Robot', 0)}</Robot>"
    text = f"{head}<!-- é -->{end}{root}{end}"
    return _case(text, numbers, keys, encoding)


_indices = st.integers(0x2000, 0x2003)
_subindices = st.integers(0, 0x1F)
_objects = st.tuples(_indices, _subindices)
_integers = st.sampled_from(["0", "17", "0x1F", "0x0000ab", "123456"])
_FIRST_LINES = (
    "; Müller, 32.96",
    "[FileInfo]",
    "",
    "[Comments]",
    "[DeviceInfo]",
)
_FURTHER_LINES: tuple[list[str], ...] = (
    [],
    [""],
    ["PDOMapping=0"],
    ["Denotation=32.96"],
)


@st.composite
def _dcf_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    first = choose(draw, *_FIRST_LINES)
    lines = [first]
    if first.startswith("["):
        lines.append("Lines=1")
        lines.append("Line1=made by hand; 7")
    objects = draw(st.lists(_objects, max_size=6, unique=True))
    for index, sub in objects:
        if sub or draw(st.booleans()):
            title = f"{index:04X}sub{sub:X}"
        else:
            title = f"{index:04x}"
        kind = draw(st.sampled_from([4, 8, 0x11, 7]))
        space = choose(draw, "", " ")
        lines.append(f"[{title}]")
        lines.append(f"ParameterName=gain {index}")
        lines.append(f"DataType=0x{kind:04X}")
        lines.append("DefaultValue=32.96")
        if draw(st.booleans()):
            lines.append("; the value é")
        if draw(st.booleans()):
            lower_case = f"{index:04x}sub{sub:x}"
            with_colon = f"{index:04X}:{sub:02X}"
            hexadecimal = f"0x{index:X}sub{sub:X}"
            keys.append(choose(draw, lower_case, with_colon, hexadecimal))
            values = _numbers
            if kind in (4, 7):
                values = _integers
            numbers.append(draw(values))
            name = choose(draw, "ParameterValue", "parametervalue")
            lines.append(f"{name}{space}={space}{_HOLE}{space}")
        lines += draw(st.sampled_from(_FURTHER_LINES))
    text = end.join(lines)
    text += choose(draw, "", end)
    return _case(text, numbers, keys, "iso-8859-1")


def _json_tree(content: bytes) -> object:
    text = content.decode("utf-8-sig")
    return json.loads(text, parse_float=float, parse_int=float)


def _xml_tree(content: bytes) -> object:
    target = ElementTree.TreeBuilder(insert_comments=True, insert_pis=True)
    parser = ElementTree.XMLParser(target=target)
    found = []
    for element in ElementTree.fromstring(content, parser).iter():
        attributes = sorted(element.attrib.items())
        found.append((element.tag, attributes, element.text, element.tail))
    return found


def _dcf_tree(content: bytes) -> object:
    parser = configparser.RawConfigParser(strict=False, delimiters=("=",), comment_prefixes=(";",))
    parser.read_string(content.decode("latin-1"))
    tree = {}
    for section in parser.sections():
        tree[section] = dict(parser.items(section))
    return tree


#: Files of each format, and a reader that knows nothing of their keys
CASES = {
    ControllerFormat.JSON: (_json_cases(), _json_tree),
    ControllerFormat.XML: (_xml_cases(), _xml_tree),
    ControllerFormat.DCF: (_dcf_cases(), _dcf_tree),
}


def in_format(content: bytes, kind: ControllerFormat) -> ControllerDocument:
    """A document whose name says nothing about its format."""
    return decode_document(content, "robot", kind)


def rewritten(scalar: Scalar, gain: float) -> str:
    """How a gain is written in the place of a number; an integer has no gain near 0."""
    std = 0.003 * abs(gain)
    if scalar.integer is not None:
        gain = abs(round(gain)) + 1
    return rewrite_gain(scalar, gain, std).spelling


def refusal(document: ControllerDocument, key: str) -> str:
    """The message of a document without a number that this key may change."""
    with pytest.raises(ControllerUnfit) as caught:
        document.locate((key,))
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(CASES), ids=lambda kind: kind.value)
@EXAMPLES
@given(data=st.data())
def test_only_the_numbers_meant_change(kind: ControllerFormat, data: st.DataObject) -> None:
    cases, _ = CASES[kind]
    case = data.draw(cases)
    content = case.content(case.numbers)
    document = in_format(content, kind)
    assert document.content == content
    found = document.locate(case.keys)
    texts = [scalar.text for scalar in found]
    assert texts == list(case.numbers)
    spelling = {}
    for key, scalar in zip(case.keys, found, strict=True):
        gain = data.draw(_gains)
        spelling[key] = rewritten(scalar, gain)
    numbers = tuple(spelling.values())

    changed = document.with_values(spelling)

    assert changed.content == case.content(numbers)
    changed_scalars = changed.locate(case.keys)
    changed_texts = [scalar.text for scalar in changed_scalars]
    assert changed_texts == list(numbers)
    unchanged = document.with_values({})
    assert unchanged.content == document.content
    reread = in_format(changed.content, kind)
    reread.check_against(document, spelling)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(CASES), ids=lambda kind: kind.value)
@EXAMPLES
@given(data=st.data())
def test_another_reader_sees_the_new_numbers_and_nothing_else_new(
    kind: ControllerFormat, data: st.DataObject
) -> None:
    """The readers know nothing of the keys, and read the file whole."""
    cases, tree = CASES[kind]
    case = data.draw(cases)
    content = case.content(case.numbers)
    document = in_format(content, kind)
    places = range(len(case.keys))
    marks = tuple(str(70000 + place) for place in places)
    spelling = dict(zip(case.keys, marks, strict=True))
    changed = document.with_values(spelling)
    seen = repr(tree(changed.content))
    before = repr(tree(document.content))
    for mark in marks:
        assert seen.count(mark) == 1
    if case.keys:
        assert seen != before
    # Each mark put back to a common blank, and the old numbers too, the two are the same.
    blank = ("70000",) * len(marks)
    from_start = in_format(case.content(blank), kind)
    from_marks = changed.with_values(dict.fromkeys(case.keys, "70000"))
    assert tree(from_start.content) == tree(from_marks.content)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(CASES), ids=lambda kind: kind.value)
@EXAMPLES
@given(data=st.data())
def test_any_other_difference_is_found(kind: ControllerFormat, data: st.DataObject) -> None:
    cases, _ = CASES[kind]
    with_numbers = cases.filter(lambda case: bool(case.keys))
    case = data.draw(with_numbers)
    document = in_format(case.content(case.numbers), kind)
    spelling = dict.fromkeys(case.keys, "7000")
    content = document.with_values(spelling).content
    last = len(content) - 1
    at = data.draw(st.integers(0, last))
    before = content[at]
    other_bytes = st.integers(1, 126).filter(lambda byte: byte != before)
    damaged = bytearray(content)
    damaged[at] = data.draw(other_bytes)
    with pytest.raises(ControllerUnfit):
        in_format(bytes(damaged), kind).check_against(document, spelling)


_BEGINNINGS = [
    b"",
    b"\xff\xfe",
    b"[",
    b"{",
    b"{}",
    b"<a",
    b"<a/>",
    b"[6076]\n",
    b"\0",
]


@pytest.mark.parametrize("kind", list(ControllerFormat), ids=lambda kind: kind.value)
@given(begin=st.sampled_from(_BEGINNINGS), noise=st.binary(max_size=60))
def test_whatever_is_in_the_file_it_is_refused_in_words(
    kind: ControllerFormat, begin: bytes, noise: bytes
) -> None:
    content = begin + noise
    with pytest.raises(ControllerUnfit, match=r"nothing was written|is this the right file"):
        in_format(content, kind).locate(("6076.nowhere",))


def test_a_line_that_goes_on_with_no_value_is_no_dcf() -> None:
    """To `configparser`, an indented line belongs to the value above it."""
    content = b"[2003]\nDataType=8\nParameterValue=1.5\n[6076]\nflag\n  x\n"
    document = decode_document(content, "a.dcf")
    with pytest.raises(ControllerUnfit, match=r"no DCF"):
        document.with_values({"2003": "2.5"})


_DCF_LINES = [
    "[6076]",
    "[2003]",
    "flag",
    "  x",
    "a=1",
    "=",
    "ParameterValue=1.5",
    ";",
    "",
]


@settings(max_examples=300)
@given(lines=st.lists(st.sampled_from(_DCF_LINES)))
def test_a_dcf_of_any_lines_is_read_or_refused_in_words(lines: list[str]) -> None:
    content = "\n".join(lines).encode()
    document = decode_document(content, "a.dcf")
    with suppress(ControllerUnfit):
        document.readings()


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ('{"J1": {"gain": 1.0}}', "J2.gain", "no key 'J2' in the file (it has J1)"),
        ('{"J1": {"gain": 1.0}}', "J1.kp", "no key 'kp' in J1 (it has gain)"),
        ('{"J1": {"gain": 1.0}}', "J1", "a list or mapping"),
        ('{"J1": {"gain": 1.0}}', "J1.gain.value", "no key 'value' in J1.gain"),
        ('{"gains": [1.0, 2.0]}', "gains.2", "no key '2' in gains (it has 0, 1)"),
        ('{"J1": "1.0"}', "J1", "without quotes"),
        ('{"J1": null}', "J1", "found null"),
        ('{"J1": NaN}', "J1", "no NaN and no Infinity"),
        ('{"J1": -Infinity}', "J1", "no NaN and no Infinity"),
        ('{"J1": 1.0, "J1": 2.0}', "J1", '"J1" a second time'),
        ('{"a": {"b": 1, "\\u0062": 2}, "J1": 1.0}', "J1", "a second time"),
        ('{"J1": 1.0,}', "J1", "no JSON (line 1 column 11: ',}')"),
        ('{"J1": [1.0,\n]}', "J1", "no JSON (line 1 column 12: ',')"),
        ('{"J1": 01.0}', "J1", "no JSON (line 1 column 9: '1.0}')"),
        ('{"J1": 1.0 // new\n}', "J1", "no JSON (line 1 column 12: '// new')"),
        ('{\n"J1": 1.0', "J1", "no JSON (line 2 column 10: the end of the line)"),
        ('{"J1": 1.0,\n', "J1", "no JSON (line 2 column 1: the end of the line)"),
        ("", "J1", "no JSON (line 1 column 1: the end of the line)"),
        ('{"J1": 1.0}{', "J1", "no JSON (line 1 column 12: '{')"),
        ("[" * 200 + "]" * 200, "0", "at most 100 lists in lists"),
    ],
)
def test_json_that_does_not_fit_is_refused(text: str, key: str, says: str) -> None:
    with pytest.raises(ControllerUnfit) as caught:
        JsonDocument("robot", text).locate((key,))
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("<R><G>1</G></R>", "R/H", "no H in R (it has G)"),
        ("<R><G>1</G></R>", "S/G", "no S in the file (it has R)"),
        ("<R><G>1</G><G>2</G></R>", "R/G", "2 of G in R, on lines 1, 1"),
        ("<R><G>1</G></R>", "R/G[2]", "no G[2] in R"),
        ("<R><G n='a'>1</G></R>", "R/G[@n='b']", "no G[@n='b'] in R"),
        ("<R><G n='a'>1</G></R>", "R/G/@m", "no attribute @m in R/G (it has @n)"),
        ("<R><G>1</G></R>", "R/G[@n=a]", "a path that cannot be read from '[@n=a]' on"),
        ("<R><G>1</G></R>", "R//G", "a path that cannot be read"),
        ("<R><G>1</G></R>", "", "a path that cannot be read"),
        ("<R><G>1</G></R>", "R", "line 1: '<G>1</G>'"),
        ("<R><G/></R>", "R/G", "line 1: ''"),
        ("<R><G><![CDATA[1]]></G></R>", "R/G", "CDATA"),
        ("<R><G>1<!-- x --></G></R>", "R/G", "comments"),
        ("<R><G>&#49;</G></R>", "R/G", "entities"),
        ("<R><G g='&#49;'/></R>", "R/G/@g", "entities"),
        ("<R><G>1,5</G></R>", "R/G", "'1,5'"),
        ("<R><G>NaN</G></R>", "R/G", "'NaN'"),
        ("<R><G>0x10</G></R>", "R/G", "'0x10'"),
    ],
)
def test_a_number_in_xml_that_cannot_be_changed_alone_is_refused(
    text: str, key: str, says: str
) -> None:
    document = XmlDocument("robot", text, "utf-8")
    message = refusal(document, key)
    assert says in message
    assert "nothing was written" in message


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'<!DOCTYPE R [<!ENTITY a "1">]><R><G>&a;</G></R>', "a document type"),
        (b'<!DOCTYPE R SYSTEM "file:///etc/passwd"><R/>', "a document type"),
        (b"<R><G>1</R>", "mismatched tag"),
        (b"<R/><R/>", "junk after document element"),
        (b"<R>&a;</R>", "undefined entity"),
        ("<R><G>1</G></R>".encode("utf-16"), "save the file as UTF-8"),
        ('<?xml version="1.0" encoding="shift_jis"?><R/>'.encode("shift_jis"), "multi-byte"),
        (b'<?xml version="1.0" encoding="klingon"?><R/>', "unknown encoding"),
    ],
)
def test_xml_that_is_not_safe_or_none_is_refused(content: bytes, says: str) -> None:
    with pytest.raises(ControllerUnfit) as caught:
        decode_document(content, "robot.xml")
    assert says in str(caught.value)


@pytest.mark.slow
def test_deep_and_wide_xml_takes_no_recursion() -> None:
    nested = b"<a>" * 20_000 + b"</a>" * 20_000
    siblings = b"<b/>" * 20_000
    content = b"<R><G>1.5</G>" + nested + siblings + b"</R>"
    document = decode_document(content, "robot.xml")
    changed = document.with_values({"R/G": "2.5000"})
    assert b"<G>2.5000</G>" in changed.content


_DCF = """\
[6076]
ParameterName=Motor rated torque
DataType=0x0007
ParameterValue=0x5DC
[2003]
ObjectType=0x9
SubNumber=3
[2003sub1]
DataType=0x0003
LowLimit=-400
HighLimit=400
ParameterValue=-0
[2003sub2]
DataType=0x0008
ParameterValue=1.5
[2003sub3]
DataType=0x0009
ParameterValue=abc
[2003subA]
DataType=0x0004
ParameterValue=$NODEID+0x10
[2004]
DataType=0x0008
ParameterValue=0x3F800000
[2005]
DataType=0x0003
ParameterValue=0xFFF0
[2006]
DataType=0x0003
DefaultValue=7
[2007]
DataType=0x0003
ParameterValue=7
ParameterValue=8
[2008]
DataType=0x0003
ParameterValue=7 ; the gain
[2009]
DataType=0x0003
ParameterValue=010
[200A]
DataType=0x0003
ParameterValue=1
[200a]
DataType=0x0003
ParameterValue=2
[200B]
DataType=0x0003
LowLimit=few
ParameterValue=2
[200Csub1]
DataType=0x0008
ParameterValue=1.5
[200csub01]
DataType=0x0008
ParameterValue=2.5
[200Dsub0A]
DataType=0x0008
ParameterValue=1.5
"""


@pytest.mark.parametrize(
    ("key", "says"),
    [
        ("6077", "no section [6077] or [6077sub0] (it does not have this index at all)"),
        ("2003:04", "no section [2003sub4] (it has 2003, 2003sub1, 2003sub2, 2003sub3, 2003suba)"),
        ("2003", "an array or record"),
        ("gain", "a key that names no object"),
        ("2003:03", "DataType 0x0009"),
        ("2003:0A", "'$NODEID+0x10'"),
        ("2004", "'0x3F800000' in a real object"),
        ("2006", "without ParameterValue"),
        ("2007", "parametervalue twice"),
        ("2008", "'7 ; the gain'"),
        ("2009", "'010'"),
        ("200A", "it 2 times, on lines"),
        ("200B", "few as lowlimit"),
        ("200C:01", "it 2 times, on lines"),
    ],
)
def test_an_object_that_cannot_be_changed_alone_is_refused(key: str, says: str) -> None:
    document = DcfDocument("drive.dcf", _DCF)
    assert says in refusal(document, key)


_RECORD = """\
[2003]
ObjectType={object_type}
SubNumber=2
[2003sub0]
ObjectType=0x7
DataType=0x0005
ParameterValue=1
[2003sub1]
ObjectType=0x7
DataType=0x0004
ParameterValue=32960
"""


@pytest.mark.parametrize("object_type", ["0x8", "0x9", "8", "9"])
def test_the_name_of_a_record_asks_for_a_subindex_and_not_to_remove_a_section(
    object_type: str,
) -> None:
    document = DcfDocument("drive.dcf", _RECORD.format(object_type=object_type))
    with pytest.raises(
        ControllerUnfit,
        match=r"\[2003\], an array or record.*name one of its "
        r"subindices",
    ):
        document.locate(("2003",))
    count, gain = document.locate(("2003:00", "2003:01"))
    assert count.value == 1.0
    assert gain.value == 32960.0


def test_a_variable_with_two_sections_is_still_refused() -> None:
    document = DcfDocument("drive.dcf", _RECORD.format(object_type="0x7"))
    with pytest.raises(ControllerUnfit, match="it 2 times, on lines 1 and 4"):
        document.locate(("2003",))


_COMPACT = """\
[2003]
ParameterName=Gains
ObjectType=0x8
DataType=0x0008
CompactSubObj=3
[2003Name]
NrOfEntries=1
1=Gain of the motor
[2003Value]
NrOfEntries=2
1=1.5
3=32.5
[2004]
ObjectType=0x8
DataType=0x0004
CompactSubObj=2
"""


def test_an_element_of_an_array_in_compact_storage_is_changed_in_its_list_of_values() -> None:
    document = DcfDocument("drive.dcf", _COMPACT)
    scalars = document.locate(("2003:01", "2003sub3"))
    values = [scalar.value for scalar in scalars]
    assert values == [1.5, 32.5]
    changed = document.with_values({"2003:03": "33.0000"})
    assert changed.text == _COMPACT.replace("3=32.5", "3=33.0000")


@pytest.mark.parametrize(
    ("key", "says"),
    [
        ("2003:02", "[2003Value] without 2, so the device has its default"),
        ("2003:04", "[2003] with CompactSubObj=3; expected a subindex from 1 to 3"),
        ("2004:01", "[2004] in compact storage, without [2004Value]"),
        ("2003", "[2003], an array or record"),
    ],
)
def test_an_element_in_compact_storage_that_has_no_value_is_refused(key: str, says: str) -> None:
    document = DcfDocument("drive.dcf", _COMPACT)
    assert says in refusal(document, key)


def test_two_lists_of_values_of_one_array_are_refused() -> None:
    dcf_document = DcfDocument("drive.dcf", _COMPACT + "[2003value]\n1=2.5\n")
    with pytest.raises(ControllerUnfit, match=r"\[2003Value\] 2 times, on lines 9 and 17"):
        dcf_document.locate(("2003:01",))


@pytest.mark.parametrize("value", ["$NODEID+0x10", "0x10+$NODEID", "$NodeId + 16"])
def test_a_value_that_depends_on_the_node_is_refused_on_either_side(value: str) -> None:
    text = f"[2003]\nDataType=0x0004\nParameterValue={value}\n"
    with pytest.raises(ControllerUnfit, match="write a plain integer"):
        DcfDocument("drive.dcf", text).locate(("2003",))


@pytest.mark.parametrize(
    "number", ["0x0_8", "0_8", "0b1000", "0o10", "010", "+8", "-0x8", "8.0", "0x", "8h"]
)
@pytest.mark.parametrize("entry", ["DataType", "ObjectType"])
def test_a_type_is_decimal_or_hexadecimal_digits(entry: str, number: str) -> None:
    kinds = {"DataType": "0x0008", "ObjectType": "0x7"}
    kinds[entry] = number
    lines = ["[2003]"]
    for name, written in kinds.items():
        lines.append(f"{name}={written}")
    lines.append("ParameterValue=1.5\n")
    document = DcfDocument("drive.dcf", "\n".join(lines))
    message = refusal(document, "2003")
    line = lines.index(f"{entry}={number}") + 1
    name = entry.lower()
    assert f"line {line}: '{number}'; expected {name} in decimal digits" in message


def one_object(data_type: str, number: str) -> DcfDocument:
    """A device configuration of one object."""
    text = f"[2003]\nDataType={data_type}\nParameterValue={number}\n"
    return DcfDocument("drive.dcf", text)


@pytest.mark.parametrize("kind", ["0x0008", "0X8", "8", "0x00000008", "0x11", "17"])
def test_a_type_may_be_written_in_each_way_that_cia_306_knows(kind: str) -> None:
    (scalar,) = one_object(kind, "1.5").locate(("2003",))
    assert scalar.value == 1.5


@pytest.mark.parametrize("number", ["010", "-010", "+010", "08", "00", "007"])
@pytest.mark.parametrize("kind", ["0x0004", "0x0008", "0x0011"])
def test_a_number_of_a_dcf_that_begins_with_zero_is_not_guessed(kind: str, number: str) -> None:
    """10 to a reader of decimals, 8 to one of CiA 306."""
    message = refusal(one_object(kind, number), "2003")
    assert f"line 3: '{number}'" in message
    assert "octal" in message
    assert "nothing was written" in message


@pytest.mark.parametrize(
    ("number", "value"), [("0", 0.0), ("0.10", 0.1), ("010.5", 10.5), ("-0.0", 0.0), ("10", 10.0)]
)
def test_a_real_of_a_dcf_with_a_point_is_no_octal_number(number: str, value: float) -> None:
    (scalar,) = one_object("8", number).locate(("2003",))
    assert scalar.value == value


def test_a_number_of_xml_that_begins_with_zero_is_decimal() -> None:
    """As xs:double says."""
    document = XmlDocument("robot", "<R><G>010</G></R>", "utf-8")
    (scalar,) = document.locate(("R/G",))
    assert scalar.value == 10.0


@pytest.mark.parametrize("key", ["200D:0A", "200dsubA", "0x200Dsub0a"])
def test_an_object_is_its_index_and_subindex_however_its_section_spells_them(key: str) -> None:
    changed = DcfDocument("drive.dcf", _DCF).with_values({key: "2.5000"})
    expected = _DCF.replace(
        "[200Dsub0A]\nDataType=0x0008\nParameterValue=1.5",
        "[200Dsub0A]\nDataType=0x0008\nParameterValue=2.5000",
    )
    assert changed.text == expected


@pytest.mark.parametrize(
    ("key", "gain", "std", "factor", "spelling"),
    [
        ("6076", 1.2344, 0.001, 1000.0, "0x4D2"),
        ("2003:01", -0.2, 0.02, 1000.0, "-200"),
        ("2003sub2", 33.91234, 0.03, 1.0, "33.9123"),
        ("2005", -20.0, 0.6, 1.0, "0xFFEC"),
        ("2005", 300.2, 0.6, 1.0, "0x012C"),
    ],
)
def test_an_integer_keeps_its_style_and_another_unit_its_factor(
    key: str, gain: float, std: float, factor: float, spelling: str
) -> None:
    document = DcfDocument("drive.dcf", _DCF)
    (scalar,) = document.locate((key,))
    reported = rewrite_gain(scalar, gain, std, factor)
    assert reported.spelling == spelling
    difference = reported.new - gain
    assert abs(difference) <= std
    expected = scalar.value / factor
    assert reported.current_gain == expected
    changed = document.with_values({key: spelling})
    (read,) = changed.locate((key,))
    assert read.value / factor == reported.new


@pytest.mark.parametrize(
    ("key", "gain", "std", "factor", "says"),
    [
        ("6076", 33.4, 0.1, 1.0, "33.4 ± 0.1, which the integer 33 does not represent"),
        ("6076", 0.3, 0.5, 1.0, "the integer 0 does not represent"),
        ("6076", -3.0, 0.5, 1.0, "-3 for an integer of 0 to 4294967295"),
        ("2003:01", 0.4001, 1e-3, 1000.0, "0.4"),
        ("2003:01", 0.401, 1e-3, 1000.0, "401 for an integer of -400 to 400"),
        ("2005", 33.0, 0.1, 1000.0, "33000 for an integer of -32768 to 32767"),
    ],
)
def test_an_integer_that_does_not_report_the_gain_is_refused(
    key: str, gain: float, std: float, factor: float, says: str
) -> None:
    document = DcfDocument("drive.dcf", _DCF)
    (scalar,) = document.locate((key,))
    if says == "0.4":
        reported = rewrite_gain(scalar, gain, std, factor)
        assert reported.spelling == "400"
        return
    with pytest.raises(ControllerUnfit) as caught:
        rewrite_gain(scalar, gain, std, factor)
    assert says in str(caught.value)


def test_the_same_number_stays_as_the_human_wrote_it() -> None:
    dcf_document = DcfDocument("drive.dcf", _DCF)
    (hexadecimal,) = dcf_document.locate(("6076",))
    same_hexadecimal = rewrite_gain(hexadecimal, 1.5, 0.01, 1000.0)
    assert same_hexadecimal.spelling == "0x5DC"
    json_document = JsonDocument("robot", '{"a": 32960}')
    (decimal,) = json_document.locate(("a",))
    same_decimal = rewrite_gain(decimal, 32.96, 0.01, 1000.0)
    other_decimal = rewrite_gain(decimal, 32.97, 0.01, 1000.0)
    assert same_decimal.spelling == "32960"
    assert other_decimal != same_decimal


@pytest.mark.parametrize(
    "name", ["Elmo_cob.dcf", "ElmoSimplIQ_cob.dcf", "Schunk_0_63_cob.dcf", "pilz_prbt_0_1.dcf"]
)
def test_a_real_device_configuration_changes_in_one_number_alone(
    shared_data: Path, name: str
) -> None:
    content = (shared_data / "eds" / name).read_bytes()
    document = decode_document(content, name)
    heartbeat = "1017"
    (scalar,) = document.locate((heartbeat,))
    changed = document.with_values({heartbeat: "123"})
    before = content[: scalar.start]
    number = content[scalar.start : scalar.end]
    after = content[scalar.end :]
    assert changed.content == before + b"123" + after
    assert number.decode() == scalar.text


@pytest.mark.parametrize("name", ["maxon_epos4.eds", "ros2_canopen_cia402_slave.eds"])
def test_a_real_data_sheet_has_no_value_to_change(shared_data: Path, name: str) -> None:
    content = (shared_data / "eds" / name).read_bytes()
    document = decode_document(content, name)
    with pytest.raises(ControllerUnfit, match="without ParameterValue"):
        document.locate(("1017",))


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        ('{"ros.params": {"gains": {"J1": 1.5, "J2": 2.5}}}', ControllerFormat.JSON),
        ("ros.params:\n  gains: {J1: 1.5, J2: 2.5}\n", ControllerFormat.YAML),
    ],
)
def test_a_key_that_is_misspelt_is_answered_by_the_nearest_one(
    content: str, kind: ControllerFormat
) -> None:
    """Names of the file have dots: no step of the key says what is wrong with it."""
    document = in_format(content.encode(), kind)
    assert "the nearest key is ros.params.gains.J1;" in refusal(document, "ros.params.gain.J1")
    assert "nearest" not in refusal(document, "speed")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.yaml", ControllerFormat.YAML),
        ("a.YML", ControllerFormat.YAML),
        ("a.json", ControllerFormat.JSON),
        ("a.xml", ControllerFormat.XML),
        ("a.dcf", ControllerFormat.DCF),
        ("folder.xml/a.EDS", ControllerFormat.DCF),
        ("a.json.20250102T030405Z.0123456789ab-0123456789ab.bak", ControllerFormat.JSON),
        ("a.conf", ControllerFormat.YAML),
    ],
)
def test_the_name_gives_the_format(name: str, kind: ControllerFormat) -> None:
    assert format_of(name) is kind


def test_every_format_has_a_reader_and_suffixes_of_its_own() -> None:
    assert set(FORMATS) == set(ControllerFormat)
    suffixes: list[str] = []
    suffixes_by_format = [kind.suffixes for kind in FORMATS.values()]
    for of_format in suffixes_by_format:
        suffixes.extend(of_format)
    assert len(suffixes) == len(set(suffixes))
    assert all(suffixes_by_format)


def test_the_configuration_may_give_the_format_instead() -> None:
    configured = decode_document(b"<a/>", "a.cfg", ControllerFormat.XML)
    by_name = decode_document(b"a: 1", "a.cfg")
    assert type(configured) is XmlDocument
    assert type(by_name) is YamlDocument


def test_only_a_regular_file_of_bounded_size_is_read(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.yaml"
    large = tmp_path / "large.yaml"
    folder = tmp_path / "folder.yaml"
    missing = tmp_path / "none"
    device = Path("/dev/zero")
    os.mkfifo(pipe)
    folder.mkdir()
    with large.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    refused = {
        pipe: "no regular file",
        device: "no regular file",
        folder: "is a directory",
        large: "at most 4 MiB",
        missing: "no such file",
    }
    for path, says in refused.items():
        with pytest.raises(ControllerUnfit, match=says):
            read_controller_file(path)
    there = tmp_path / "there.yaml"
    there.write_bytes(b"a: 1\n")
    link = tmp_path / "link.yaml"
    link.symlink_to(there)
    assert read_controller_file(link) == b"a: 1\n"


@pytest.mark.parametrize(
    ("name", "text", "comment"),
    [
        (
            "a.yaml",
            "gain: 32.96   # Nm per A, from the data sheet \nother: 1\n",
            "Nm per A, from the data sheet",
        ),
        ("a.yaml", "gain: '32.96' # of 'J1': {a: #2}\r\n", "of 'J1': {a: #2}"),
        ("a.yaml", "{gain: 32.96, kp: 7}  # both", "both"),
        ("a.yaml", "gain: 32.96\n# of the next line\n", ""),
        ("a.yaml", "gain: 32.96 #\nkp: 7 # of another number\n", ""),
        ("a.xml", "<gain>32.96</gain> <!-- old --> <!-- second -->\n", "old"),
        ("a.xml", "<gain>32.96</gain>\n<!-- of the next line -->\n", ""),
        ("a.json", '{"gain": 32.96}  # no comment', ""),
        ("a.dcf", "ParameterValue=32.96\n; of the next line\n", ""),
    ],
)
def test_the_comment_behind_a_number_is_that_of_its_line(
    name: str, text: str, comment: str
) -> None:
    rest = text.partition("32.96")[2]
    assert comment_behind(rest, name) == comment
    suffix = Path(name).suffix
    formats = {
        ".yaml": ControllerFormat.YAML,
        ".xml": ControllerFormat.XML,
    }
    as_format = formats.get(suffix)
    if as_format is not None:
        assert comment_behind(rest, "a.conf", as_format) == comment


_DOTTED_YAML = (
    "node:\n  ros__parameters:\n    gains.J1.nm_per_a: 32.96\n    gains: {J2: {nm_per_a: -11.52}}\n"
)
_DOTTED_JSON = (
    '{"node": {"ros__parameters": {"gains.J1.nm_per_a": 32.96, "gains": {"J2": '
    '{"nm_per_a": -11.52}}}}}'
)


@pytest.mark.parametrize(
    ("name", "text"), [("ros2.yaml", _DOTTED_YAML), ("ros2.json", _DOTTED_JSON)]
)
def test_keys_of_the_file_may_have_dots(name: str, text: str) -> None:
    document = decode_document(text.encode(), name)
    key_of_j1 = "node.ros__parameters.gains.J1.nm_per_a"
    key_of_j2 = "node.ros__parameters.gains.J2.nm_per_a"
    first, second = document.locate((key_of_j1, key_of_j2))
    assert first.value == 32.96
    assert second.value == -11.52
    changed = document.with_values({key_of_j1: "33.10"})
    assert changed.text == text.replace("32.96", "33.10")


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.yaml", "a.b: 1.5\na: {b: 2.5}\n"), ("a.json", '{"a.b": 1.5, "a": {"b": 2.5}}')],
)
def test_a_key_that_two_places_read_as_is_refused(name: str, text: str) -> None:
    document = decode_document(text.encode(), name)
    with pytest.raises(
        ControllerUnfit,
        match=r"2 places that read as this key: (a\.b and a / b|a "
        r"/ b and a\.b)",
    ):
        document.locate(("a.b",))


@pytest.mark.parametrize(
    ("file", "text", "key"),
    [
        ("a.yaml", "gain: 1e400\n", "gain"),
        ("a.json", '{"gain": 1e400}', "gain"),
        ("a.xml", "<a><gain>1e400</gain></a>", "a/gain"),
        ("a.dcf", "[2003]\nDataType=0x0008\nParameterValue=-1e400\n", "2003"),
    ],
)
def test_a_number_beyond_every_number_is_no_gain(file: str, text: str, key: str) -> None:
    """It was read as infinity."""
    document = decode_document(text.encode(), file)
    with pytest.raises(ControllerUnfit, match=r"1e400, beyond every number of a computer"):
        document.locate((key,))


def _integer_document(number: str, limits: str = "") -> DcfDocument:
    text = f"[2003]\nDataType=0x0004\n{limits}ParameterValue={number}\n"
    document = decode_document(text.encode(), "a.dcf")
    assert isinstance(document, DcfDocument)
    return document


@pytest.mark.parametrize("number", ["2147483648", "4294967295", "-2147483649"])
def test_an_integer_of_a_dcf_that_its_type_does_not_hold_is_refused(number: str) -> None:
    """4294967295 of an INTEGER32 is −1 in the drive; it was read as 4294967295."""
    document = _integer_document(number)
    with pytest.raises(ControllerUnfit, match="an integer of its type"):
        document.locate(("2003",))


def test_a_limit_of_a_dcf_does_not_make_an_object_unsigned() -> None:
    for limits in ("LowLimit=0\n", "LowLimit=0x80000000\nHighLimit=0x7FFFFFFF\n"):
        document = _integer_document("0xFFFFFFFF", limits)
        (scalar,) = document.locate(("2003",))
        assert scalar.value == -1.0


def test_a_long_line_of_blanks_in_a_dcf_does_not_hold_up_its_reader() -> None:
    """It did not end in minutes: a regular expression tried each blank as the end of the name."""
    blanks = " " * 200_000
    text = f"[2003]\nDataType=0x0008\n ParameterValue =  12.5  \n{blanks}\n"
    document = decode_document(text.encode(), "a.dcf")
    (scalar,) = document.locate(("2003",))
    assert scalar.value == 12.5
    assert text[scalar.start : scalar.end] == "12.5"


@pytest.mark.parametrize("line", ["a{}b=1", "a{}b"])
def test_blanks_in_a_name_of_a_dcf_do_not_hold_up_its_second_reader(line: str) -> None:
    """The time of configparser grows with their square: 200 000 would take an hour."""
    long_line = line.format(" " * 200_000)
    text = f"[2003]\nDataType=0x0008\nParameterValue=12.5\n{long_line}\n"
    document = decode_document(text.encode(), "a.dcf")
    with pytest.raises(ControllerUnfit, match=r"a\.dcf:4.*200002 characters"):
        document.readings()


def test_a_long_comment_and_a_long_value_of_a_dcf_are_read() -> None:
    long = "x " * 5_000
    text = f"[2003]\nDataType=0x0008\nParameterValue=12.5\nDenotation={long}\n; {long}\n"
    document = decode_document(text.encode(), "a.dcf")
    first, second = document.readings()
    denotation = long.strip()
    assert first["2003", "denotation"] == denotation
    assert second["2003", "denotation"] == denotation
