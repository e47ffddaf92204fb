"""Controllers' documents in JSON, XML and DCF:
only the numbers meant change, as bytes and as any parser sees them.
"""

from __future__ import annotations

import configparser
import json
import os
from collections.abc import Callable
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
from daq.formats.scalar import ControllerDocument, rewrite_gain
from daq.formats.xml_document import XmlDocument
from daq.formats.yaml_document import YamlDocument

EXAMPLES = settings(max_examples=80)
_numbers = st.sampled_from(
    ["32.96", "-11.52", "7", "0", "1e3", "2.5E-3", "0.10", "-0.0", "123456789.125"]
)
_gains = st.floats(1e-3, 1e4).flatmap(lambda gain: st.sampled_from([gain, -gain]))
_ends = st.sampled_from(["\n", "\r\n"])
_words = st.text("abcdefghijklmnopqrstuvwxyzéß漢", min_size=1, max_size=5)


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
        return "".join(a + b for a, b in zip(self.pieces, (*numbers, ""), strict=True)).encode(
            self.encoding
        )


_HOLE = "\0"
"""Placeholder of a number meant while a file is made."""


def _case(text: str, numbers: list[str], keys: list[str], encoding: str = "utf-8") -> _Case:
    pieces = tuple(text.split(_HOLE))
    return _Case(pieces, tuple(numbers), tuple(keys), encoding)


@st.composite
def _json_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    gap = st.sampled_from(["", " ", "\t", end, end + "    "])

    def value(path: tuple[str, ...], depth: int) -> str:
        sampled = st.sampled_from(
            ["hole", "number", "word", "text", *(["object", "list"] if depth < 3 else [])]
        )
        kind = draw(sampled)
        if kind == "hole" and path:
            numbers.append(draw(_numbers))
            keys.append(".".join(path))
            return _HOLE
        if kind == "object" or not path:
            names = draw(st.lists(_words, max_size=4, unique=True))
            inside = [
                f"{draw(gap)}{json.dumps(name, ensure_ascii=draw(st.booleans()))}{draw(gap)}:{draw(gap)}"  # noqa: E501
                f"{value((*path, name), depth + 1)}{draw(gap)}"
                for name in names
            ]
            return "{" + ",".join(inside) + "}"
        if kind == "list":
            size = draw(st.integers(0, 3))
            return (
                "["
                + ",".join(draw(gap) + value((*path, str(i)), depth + 1) for i in range(size))
                + "]"
            )
        if kind == "text":
            return json.dumps(
                draw(st.sampled_from(["32.96", 'say "7"', "\\", "déjà 漢", "{a: 1}", "\u2028"]))
            )
        if kind == "word":
            return draw(st.sampled_from(["true", "null"]))
        return draw(_numbers)

    strategy = st.sampled_from(["", "\ufeff", " ", end])
    head = draw(strategy)
    text = head + value((), 0) + draw(gap)
    return _case(text, numbers, keys)


@st.composite
def _xml_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    sampled = st.sampled_from(["utf-8", "utf-8", "iso-8859-1", "windows-1252"])
    encoding = draw(sampled)
    if encoding == "utf-8":
        names = _words
    else:
        names = st.text("abcdefgéß", min_size=1, max_size=5)
    noise = st.sampled_from(
        [
            "",
            " ",
            end,
            f"{end}  ",
            "<!-- 32.96 <Gain>7</Gain> -->",
            "<?tool keep=1?>",
            "<![CDATA[<7>]]>",
            "&#65;&amp;",
            "é",
        ]
    )

    def number(key: str) -> str:
        numbers.append(draw(_numbers))
        keys.append(key)
        return _HOLE

    def element(path: str, depth: int) -> str:
        parts = []
        used: dict[str, int] = {}
        for _ in range(draw(st.integers(0, 3))):
            name = draw(
                st.sampled_from(["Gain", "ns:Axis", "Ü", "Axis"])
                if encoding == "utf-8"
                else st.just("Axis")
            )
            used[name] = used.get(name, 0) + 1
            parts.append(draw(noise) + inner(f"{path}/{name}[{used[name]}]", name, depth + 1))
        return "".join(parts) + draw(noise)

    def inner(path: str, name: str, depth: int) -> str:
        label = draw(names)
        attributes = f" name={quoteattr(label)}"
        if draw(st.booleans()):
            quote = draw(st.sampled_from(["'", '"']))
            space = draw(st.sampled_from(["", " "]))
            before = draw(st.sampled_from([" ", end]))
            hole = number(path + "/@gain")
            attributes += f"{before}gain{space}={space}{quote}{space}{hole}{space}{quote}"
        strategy = st.sampled_from(["", " ", " note='a>b'", f"{end}x='&lt;7'"])
        attributes += draw(strategy)
        shape = draw(
            st.sampled_from(["number", "text", "empty", *(["elements"] if depth < 3 else [])])
        )
        if shape == "empty":
            return f"<{name}{attributes}/>"
        if shape == "number":
            pad = draw(st.sampled_from(["", " ", end]))
            return f"<{name}{attributes}>{pad}{number(path)}{pad}</{name}>"
        return f"<{name}{attributes}>{escape(label) if shape == 'text' else element(path, depth)}</{name}>"  # noqa: E501

    head = f'<?xml version="1.0" encoding="{encoding}"?>{end}'
    if encoding == "utf-8":
        head = draw(st.sampled_from(["", "\ufeff", head, "\ufeff" + head]))
    text = f"{head}<!-- é -->{end}<Robot xmlns:ns='urn:x'>{element('Robot', 0)}</Robot>{end}"
    return _case(text, numbers, keys, encoding)


@st.composite
def _dcf_cases(draw: st.DrawFn) -> _Case:
    numbers: list[str] = []
    keys: list[str] = []
    end = draw(_ends)
    sampled = st.sampled_from(["; Müller, 32.96", "[FileInfo]", "", "[Comments]", "[DeviceInfo]"])
    lines = [draw(sampled)]
    if lines[0].startswith("["):
        lines += ["Lines=1", "Line1=made by hand; 7"]
    objects = draw(
        st.lists(
            st.tuples(st.integers(0x2000, 0x2003), st.integers(0, 0x1F)), max_size=6, unique=True
        )
    )
    for index, sub in objects:
        if sub or draw(st.booleans()):
            title = f"{index:04X}sub{sub:X}"
        else:
            title = f"{index:04x}"
        kind = draw(st.sampled_from([4, 8, 0x11, 7]))
        space = draw(st.sampled_from(["", " "]))
        lines += [
            f"[{title}]",
            f"ParameterName=gain {index}",
            f"DataType=0x{kind:04X}",
            "DefaultValue=32.96",
        ]
        if draw(st.booleans()):
            lines.append("; the value é")
        if draw(st.booleans()):
            keys.append(
                draw(
                    st.sampled_from(
                        [
                            f"{index:04x}sub{sub:x}",
                            f"{index:04X}:{sub:02X}",
                            f"0x{index:X}sub{sub:X}",
                        ]
                    )
                )
            )
            whole = st.sampled_from(["0", "17", "0x1F", "0x0000ab", "123456"])
            numbers.append(draw(whole if kind in (4, 7) else _numbers))
            lines.append(
                f"{draw(st.sampled_from(['ParameterValue', 'parametervalue']))}{space}={space}{_HOLE}{space}"  # noqa: E501
            )
        lines += draw(st.sampled_from([[], [""], ["PDOMapping=0"], ["Denotation=32.96"]]))
    strategy = st.sampled_from(["", end])
    text = end.join(lines) + draw(strategy)
    return _case(text, numbers, keys, "iso-8859-1")


CASES = {
    ControllerFormat.JSON: _json_cases(),
    ControllerFormat.XML: _xml_cases(),
    ControllerFormat.DCF: _dcf_cases(),
}


def _json_tree(content: bytes) -> object:
    text = content.decode("utf-8-sig")
    return json.loads(text, parse_float=float, parse_int=float)


def _xml_tree(content: bytes) -> object:
    target = ElementTree.TreeBuilder(insert_comments=True, insert_pis=True)
    parser = ElementTree.XMLParser(target=target)
    found = []
    for e in ElementTree.fromstring(content, parser).iter():
        found.append((e.tag, tuple(sorted(e.attrib.items())), e.text, e.tail))
    return found


def _dcf_tree(content: bytes) -> object:
    parser = configparser.RawConfigParser(strict=False, delimiters=("=",), comment_prefixes=(";",))
    parser.read_string(content.decode("latin-1"))
    return {section: dict(parser.items(section)) for section in parser.sections()}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(CASES), ids=lambda kind: kind.value)
@EXAMPLES
@given(data=st.data())
def test_only_the_numbers_meant_change(kind: ControllerFormat, data: st.DataObject) -> None:
    case = data.draw(CASES[kind])
    content = case.content(case.numbers)
    document = decode_document(content, "robot", kind)
    expected = case.content(case.numbers)
    assert document.content == expected
    found = document.locate(case.keys)
    texts = [scalar.text for scalar in found]
    assert texts == list(case.numbers)
    spelt = tuple(
        rewrite_gain(
            scalar, gain if scalar.integer is None else abs(round(gain)) + 1, 0.003 * abs(gain)
        ).spelling
        for scalar, gain in zip(
            found,
            data.draw(st.lists(_gains, min_size=len(found), max_size=len(found))),
            strict=True,
        )
    )
    spelling = dict(zip(case.keys, spelt, strict=True))

    changed = document.with_values(spelling)

    assert changed.content == case.content(spelt)
    assert [scalar.text for scalar in changed.locate(case.keys)] == list(spelt)
    assert document.with_values({}).content == document.content
    decode_document(changed.content, "robot", kind).check_against(document, spelling)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "cases", "tree"),
    [
        (ControllerFormat.JSON, _json_cases(), _json_tree),
        (ControllerFormat.XML, _xml_cases(), _xml_tree),
        (ControllerFormat.DCF, _dcf_cases(), _dcf_tree),
    ],
    ids=["json", "xml", "dcf"],
)
@EXAMPLES
@given(data=st.data())
def test_another_reader_sees_the_new_numbers_and_nothing_else_new(
    kind: ControllerFormat,
    cases: st.SearchStrategy[_Case],
    tree: Callable[[bytes], object],
    data: st.DataObject,
) -> None:
    """The readers are none of those with which the document proves itself,
    and know nothing of its keys.
    """
    case = data.draw(cases)
    content = case.content(case.numbers)
    document = decode_document(content, "robot", kind)
    marks = tuple(str(70000 + i) for i in range(len(case.keys)))
    spelling = dict(zip(case.keys, marks, strict=True))
    changed = document.with_values(spelling)
    seen = repr(tree(changed.content))
    expected = repr(tree(document.content))
    for mark in marks:
        assert seen.count(mark) == 1
    if case.keys:
        assert seen != expected
    # Each mark put back to a common blank, and the old numbers too, the two are the same.
    blank = case.content(tuple("70000" for _ in marks))
    assert tree(decode_document(blank, "robot", kind).content) == tree(
        changed.with_values(dict.fromkeys(case.keys, "70000")).content
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(CASES), ids=lambda kind: kind.value)
@EXAMPLES
@given(data=st.data())
def test_any_other_difference_is_found(kind: ControllerFormat, data: st.DataObject) -> None:
    case = data.draw(CASES[kind].filter(lambda case: bool(case.keys)))
    document = decode_document(case.content(case.numbers), "robot", kind)
    spelling = dict.fromkeys(case.keys, "7000")
    content = document.with_values(spelling).content
    at = data.draw(st.integers(0, len(content) - 1))
    other = bytes([data.draw(st.integers(1, 126).filter(lambda byte: byte != content[at]))])
    with pytest.raises(ControllerUnfit):
        decode_document(content[:at] + other + content[at + 1 :], "robot", kind).check_against(
            document, spelling
        )


@pytest.mark.parametrize("kind", list(ControllerFormat), ids=lambda kind: kind.value)
@given(
    begin=st.sampled_from(
        [b"", b"\xff\xfe", b"[", b"{", b"{}", b"<a", b"<a/>", b"[6076]\n", b"\0"]
    ),
    noise=st.binary(max_size=60),
)
def test_whatever_is_in_the_file_it_is_refused_in_words(
    kind: ControllerFormat, begin: bytes, noise: bytes
) -> None:
    content = begin + noise
    with pytest.raises(ControllerUnfit, match=r"nothing was written|is this the right file"):
        decode_document(content, "robot", kind).locate(("6076.nowhere",))


def test_a_line_that_goes_on_with_no_value_is_no_dcf() -> None:
    """To `configparser`, an indented line belongs to the value above it."""
    document = decode_document(
        b"[2003]\nDataType=8\nParameterValue=1.5\n[6076]\nflag\n  x\n", "a.dcf"
    )
    with pytest.raises(ControllerUnfit, match=r"no DCF"):
        document.with_values({"2003": "2.5"})


@settings(max_examples=300)
@given(
    lines=st.lists(
        st.sampled_from(
            ["[6076]", "[2003]", "flag", "  x", "a=1", "=", "ParameterValue=1.5", ";", ""]
        )
    )
)
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
    with pytest.raises(ControllerUnfit) as caught:
        XmlDocument("robot", text, "utf-8").locate((key,))
    assert says in str(caught.value)
    assert "nothing was written" in str(caught.value)


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
    deep = b"<R><G>1.5</G>" + b"<a>" * 20_000 + b"</a>" * 20_000 + b"<b/>" * 20_000 + b"</R>"
    content = decode_document(deep, "robot.xml").with_values({"R/G": "2.5000"}).content
    assert b"<G>2.5000</G>" in content


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
    with pytest.raises(ControllerUnfit) as caught:
        DcfDocument("drive.dcf", _DCF).locate((key,))
    assert says in str(caught.value)


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
    assert (count.value, gain.value) == (1.0, 32960.0)


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
    scalars = [scalar.value for scalar in document.locate(("2003:01", "2003sub3"))]
    assert scalars == [1.5, 32.5]
    text = document.with_values({"2003:03": "33.0000"}).text
    assert text == _COMPACT.replace("3=32.5", "3=33.0000")


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
    with pytest.raises(ControllerUnfit) as caught:
        DcfDocument("drive.dcf", _COMPACT).locate((key,))
    assert says in str(caught.value)


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
    others = {"DataType": "0x0008", "ObjectType": "0x7"} | {entry: number}
    text = (
        "[2003]\n"
        + "".join(f"{name}={written}\n" for name, written in others.items())
        + "ParameterValue=1.5\n"
    )
    with pytest.raises(ControllerUnfit) as caught:
        DcfDocument("drive.dcf", text).locate(("2003",))
    column = f"{entry}={number}"
    line = text.splitlines().index(column) + 1
    expected = f"line {line}: '{number}'; expected {entry.lower()} in decimal digits"
    assert expected in str(caught.value)


@pytest.mark.parametrize("kind", ["0x0008", "0X8", "8", "0x00000008", "0x11", "17"])
def test_a_type_may_be_written_in_each_way_that_cia_306_knows(kind: str) -> None:
    dcf_document = DcfDocument("drive.dcf", f"[2003]\nDataType={kind}\nParameterValue=1.5\n")
    (scalar,) = dcf_document.locate(("2003",))
    assert scalar.value == 1.5


@pytest.mark.parametrize("number", ["010", "-010", "+010", "08", "00", "007"])
@pytest.mark.parametrize("kind", ["0x0004", "0x0008", "0x0011"])
def test_a_number_of_a_dcf_that_begins_with_zero_is_not_guessed(kind: str, number: str) -> None:
    """10 to a reader of decimals, 8 to one of CiA 306."""
    dcf_document = DcfDocument("drive.dcf", f"[2003]\nDataType={kind}\nParameterValue={number}\n")
    with pytest.raises(ControllerUnfit) as caught:
        dcf_document.locate(("2003",))
    expected = f"line 3: '{number}'"
    assert expected in str(caught.value)
    assert "octal" in str(caught.value)
    assert "nothing was written" in str(caught.value)


@pytest.mark.parametrize(
    ("number", "value"), [("0", 0.0), ("0.10", 0.1), ("010.5", 10.5), ("-0.0", 0.0), ("10", 10.0)]
)
def test_a_real_of_a_dcf_with_a_point_is_no_octal_number(number: str, value: float) -> None:
    dcf_document = DcfDocument("drive.dcf", f"[2003]\nDataType=8\nParameterValue={number}\n")
    (scalar,) = dcf_document.locate(("2003",))
    assert scalar.value == value


def test_a_number_of_xml_that_begins_with_zero_is_decimal() -> None:
    """As xs:double says."""
    xml_document = XmlDocument("robot", "<R><G>010</G></R>", "utf-8")
    (scalar,) = xml_document.locate(("R/G",))
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
    (read,) = document.with_values({key: spelling}).locate((key,))
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
    (scalar,) = DcfDocument("drive.dcf", _DCF).locate((key,))
    if says == "0.4":
        spelling = rewrite_gain(scalar, gain, std, factor).spelling
        assert spelling == "400"
        return
    with pytest.raises(ControllerUnfit) as caught:
        rewrite_gain(scalar, gain, std, factor)
    assert says in str(caught.value)


def test_the_same_number_stays_as_the_human_wrote_it() -> None:
    (hexadecimal,) = DcfDocument("drive.dcf", _DCF).locate(("6076",))
    spelling = rewrite_gain(hexadecimal, 1.5, 0.01, 1000.0).spelling
    assert spelling == "0x5DC"
    (decimal,) = JsonDocument("robot", '{"a": 32960}').locate(("a",))
    assert rewrite_gain(decimal, 32.96, 0.01, 1000.0).spelling == "32960"
    assert rewrite_gain(decimal, 32.97, 0.01, 1000.0) != rewrite_gain(decimal, 32.96, 0.01, 1000.0)


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
    changed = document.with_values({heartbeat: "123"}).content
    cut = (scalar.start, scalar.end)
    expected = content[: cut[0]] + b"123" + content[cut[1] :]
    assert changed == expected
    decoded_content = content[cut[0] : cut[1]].decode()
    assert decoded_content == scalar.text


@pytest.mark.parametrize("name", ["maxon_epos4.eds", "ros2_canopen_cia402_slave.eds"])
def test_a_real_data_sheet_has_no_value_to_change(shared_data: Path, name: str) -> None:
    content = (shared_data / "eds" / name).read_bytes()
    document = decode_document(content, name)
    with pytest.raises(ControllerUnfit, match="without ParameterValue"):
        document.locate(("1017",))


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
    for _, of_format in FORMATS.values():
        suffixes.extend(of_format)
    assert len(suffixes) == len(set(suffixes))
    assert all(of_format for _, of_format in FORMATS.values())


def test_the_configuration_may_give_the_format_instead() -> None:
    kinds: list[ControllerDocument] = [
        decode_document(b"<a/>", "a.cfg", ControllerFormat.XML),
        decode_document(b"a: 1", "a.cfg"),
    ]
    assert [type(kind) for kind in kinds] == [XmlDocument, YamlDocument]


def test_only_a_regular_file_of_bounded_size_is_read(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.yaml"
    large = tmp_path / "large.yaml"
    folder = tmp_path / "folder.yaml"
    os.mkfifo(pipe)
    folder.mkdir()
    with large.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    for path, says in (
        (pipe, "no regular file"),
        (Path("/dev/zero"), "no regular file"),
        (folder, "is a directory"),
        (large, "at most 4 MiB"),
        (tmp_path / "none", "no such file"),
    ):
        with pytest.raises(ControllerUnfit, match=says):
            read_controller_file(path)
    link = tmp_path / "link.yaml"
    link.symlink_to(tmp_path / "there.yaml")
    (tmp_path / "there.yaml").write_bytes(b"a: 1\n")
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
    as_format = {".yaml": ControllerFormat.YAML, ".xml": ControllerFormat.XML}.get(suffix)
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
    keys = ("node.ros__parameters.gains.J1.nm_per_a", "node.ros__parameters.gains.J2.nm_per_a")
    assert [one.value for one in document.locate(keys)] == [32.96, -11.52]
    spelling = {keys[0]: "33.10"}
    expected = text.replace("32.96", "33.10")
    assert document.with_values(spelling).text == expected


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
    with pytest.raises(ControllerUnfit, match=r"1e400, beyond every number of a computer"):
        decode_document(text.encode(), file).locate((key,))


def _integer_document(number: str, limits: str = "") -> DcfDocument:
    text = f"[2003]\nDataType=0x0004\n{limits}ParameterValue={number}\n"
    document = decode_document(text.encode(), "a.dcf")
    assert isinstance(document, DcfDocument)
    return document


@pytest.mark.parametrize("number", ["2147483648", "4294967295", "-2147483649"])
def test_an_integer_of_a_dcf_that_its_type_does_not_hold_is_refused(number: str) -> None:
    """4294967295 of an INTEGER32 is −1 in the drive; it was read as 4294967295."""
    with pytest.raises(ControllerUnfit, match="an integer of its type"):
        _integer_document(number).locate(("2003",))


def test_a_limit_of_a_dcf_does_not_make_an_object_unsigned() -> None:
    for limits in ("LowLimit=0\n", "LowLimit=0x80000000\nHighLimit=0x7FFFFFFF\n"):
        [scalar] = _integer_document("0xFFFFFFFF", limits).locate(("2003",))
        assert scalar.value == -1.0


def test_a_long_line_of_blanks_in_a_dcf_does_not_hold_up_its_reader() -> None:
    """It did not end in minutes: a regular expression tried each blank as the end of the name."""
    text = "[2003]\nDataType=0x0008\n ParameterValue =  12.5  \n" + " " * 200_000 + "\n"
    [scalar] = decode_document(text.encode(), "a.dcf").locate(("2003",))
    assert scalar.value == 12.5
    assert text[scalar.start : scalar.end] == "12.5"


@pytest.mark.parametrize("line", ["a{}b=1", "a{}b"])
def test_blanks_in_a_name_of_a_dcf_do_not_hold_up_its_second_reader(line: str) -> None:
    """The time of configparser grows with their square: 200 000 would take an hour."""
    text = "[2003]\nDataType=0x0008\nParameterValue=12.5\n" + line.format(" " * 200_000) + "\n"
    document = decode_document(text.encode(), "a.dcf")
    with pytest.raises(ControllerUnfit, match=r"a\.dcf:4.*200002 characters"):
        document.readings()


def test_a_long_comment_and_a_long_value_of_a_dcf_are_read() -> None:
    long = "x " * 5_000
    text = f"[2003]\nDataType=0x0008\nParameterValue=12.5\nDenotation={long}\n; {long}\n"
    first, second = decode_document(text.encode(), "a.dcf").readings()
    assert first["2003", "denotation"] == second["2003", "denotation"] == long.strip()
