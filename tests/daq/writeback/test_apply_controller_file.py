"""The controller's YAML file: only the numbers meant change, whatever a human has made of the rest."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from daq.errors import ControllerUnfit
from daq.formats.document import decode_document
from daq.formats.scalar import spell
from daq.formats.yaml_document import YamlDocument
from daq.ledger.audit import AuditAction, read
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose
from ident.calibration import Gain
from tests.daq.calibrations import demo_calibration, of_first_axes

_words = st.text("abcdefghijklmnopqrstuvwxyzé_", min_size=1, max_size=6).filter(
    lambda word: word not in ("y", "n", "no", "on", "off", "yes", "true", "false", "null", "gain")
)
_comments = st.sampled_from(["", "   # data sheet", " # Ü 漢 😀", " #", "          # 33.9 'quoted' {a: b}"])
_numbers = st.sampled_from(["32.96", "-11.52", "7", "+1.5", "1e3", "2.5E-3", "0.10", ".5", "5.", "00.5"])
_quotes = st.sampled_from(["", "", "", "'", '"'])
_gaps = st.sampled_from([" ", "  ", "        "])
_elsewhere = st.sampled_from(
    [
        "",
        "defaults: &d {kp: 1, ti: [1, 2.50]}|uses: *d|merged: {<<: *d, kp: 3}|",
        "text: >-|  gain: 32.96|  folded # no comment|",
        "literal: |+|  32.96|||",
        "? [a, complex key]|: {gain: 32.96, 'quoted key': \"\\u00e9 32.96\"}|",
        "deep: {a: [{b: {c: [[1, 2], {d: 32.96}]}}]}|",
        "date: 2024-01-02|octal: 0o17|hex: 0x20|flag: yes|empty:|tilde: ~|",
        "wide: [1.0,|  2.0,  # of the second||  3.0]|",
    ]
)
"""Before and behind the drives; | is a line end."""


@dataclass(frozen=True)
class _Case:
    """A generated file: its text cut where the numbers meant are, and their keys in that order."""

    pieces: tuple[str, ...]
    numbers: tuple[str, ...]
    keys: tuple[str, ...]

    def text(self, numbers: tuple[str, ...]) -> str:
        return "".join(a + b for a, b in zip(self.pieces, (*numbers, ""), strict=True))


@st.composite
def _cases(draw: st.DrawFn) -> _Case:
    newline = draw(st.sampled_from(["\n", "\r\n"]))
    axes = draw(st.lists(_words, min_size=1, max_size=4, unique=True))
    step = " " * draw(st.sampled_from([1, 2, 4]))
    head = draw(st.sampled_from(["", "\ufeff", "# a human's file", "---", "%YAML 1.1\n---", "title: 'déjà 漢 😀 vu'"]))
    around = [draw(_elsewhere).replace("|+|", "\0+|").replace("|", newline).replace("\0", "|") for _ in range(2)]
    around[1] = around[1].replace("&d", "&e").replace("*d", "*e").replace(": ", "_2: ", 1) if around[1] else ""
    pieces = [head + (newline if head.strip("\ufeff") else "") + around[0] + f"drives:{newline}"]
    numbers: list[str] = []
    keys: list[str] = []
    for axis in axes:
        shape = draw(st.sampled_from(["block", "flow", "list", "anchored", "tagged", "last"]))
        number, quote, gap, comment = draw(_numbers), draw(_quotes), draw(_gaps), draw(_comments)
        before, after = {
            "block": (f"{step}{axis}:{newline}{step * 2}gain:{gap}", f"{comment}{newline}{step * 2}kp: 32.96{newline}"),
            "flow": (f"{step}{axis}: {{gain:{gap}", f" , kp: 7 }}{comment}{newline}"),
            "list": (f"{step}{axis}:{comment}{newline}{step}- 32.96{newline}{step}-{gap}", f"{comment}{newline}"),
            "anchored": (f"{step}{axis}: {{kp: 1, gain: &{'x' * (len(keys) + 1)} ", f"}}{comment}{newline}"),
            "tagged": (f"{step}{axis}:{newline}{step * 2}gain: !!float{gap}", f"{comment}{newline}{newline}"),
            "last": (f"{step}? {axis}{newline}{step}:{step}gain:{gap}", f"{comment}{newline}# {axis}{newline}"),
        }[shape]
        pieces[-1] += before + quote
        pieces.append(quote + after)
        numbers.append(number)
        keys.append(f"drives.{axis}.{'1' if shape == 'list' else 'gain'}")
    pieces[-1] += around[1]
    return _Case(tuple(pieces), tuple(numbers), tuple(keys))


@settings(max_examples=200, deadline=None)
@given(_cases(), st.data())
def test_only_the_numbers_meant_change(case: _Case, data: st.DataObject) -> None:
    gains = data.draw(
        st.lists(
            st.floats(-1e4, 1e4).filter(lambda gain: abs(gain) > 1e-3),
            min_size=len(case.keys),
            max_size=len(case.keys),
        )
    )
    file = decode_document(case.text(case.numbers).encode(), "robot.yaml")
    found = file.locate(case.keys)
    assert [scalar.text for scalar in found] == list(case.numbers)
    assert [scalar.value for scalar in found] == [float(number) for number in case.numbers]

    spelt = tuple(spell(gain, 0.003 * abs(gain), number) for gain, number in zip(gains, case.numbers, strict=True))
    changed = file.with_values(dict(zip(case.keys, spelt, strict=True)))

    assert changed.text == case.text(spelt)
    assert [scalar.text for scalar in changed.locate(case.keys)] == list(spelt)
    assert file.with_values({}).text == file.text


@settings(max_examples=150, deadline=None)
@given(_cases(), st.data())
def test_of_a_file_on_the_disk_nothing_but_the_gains_changes(case: _Case, data: st.DataObject) -> None:
    """The whole way, with lock, audit, backup and rename; and the bytes in the file afterwards."""
    axes = [f"J{number + 1}" for number in range(len(case.keys))]
    olds = [float(number) for number in case.numbers]
    shares = data.draw(st.lists(st.floats(0.7, 1.3), min_size=len(axes), max_size=len(axes)))
    gains = tuple(
        Gain(axis, share * old, 0.004 * abs(share * old), "Nm/A", old)
        for axis, share, old in zip(axes, shares, olds, strict=True)
    )
    spelt = tuple(
        text if float(reported := spell(gain.value, gain.std, text)) == float(text) else reported
        for gain, text in zip(gains, case.numbers, strict=True)
    )
    with tempfile.TemporaryDirectory() as folder:
        file, audit = Path(folder) / "robot.yaml", Path(folder) / "audit.jsonl"
        file.write_bytes(case.text(case.numbers).encode())
        calibration = of_first_axes(replace(demo_calibration(), gains=gains), len(gains))
        keys = dict(zip(axes, case.keys, strict=True))
        # Its own file is not under test, and to spell it would take as long as all the rest.
        now = datetime(2025, 1, 2, tzinfo=UTC)
        proposal = propose(FileTarget(file, keys), Request(calibration, now, content=b"a calibration"))
        assert proposal.refusals == ()
        written = apply(proposal, now, audit=audit, who="Ada")
        assert file.read_bytes() == case.text(spelt).encode()
        if spelt != case.numbers:
            assert written is not None
            assert written.backup is not None
            assert written.backup.read_bytes() == case.text(case.numbers).encode()
            assert [entry.action for entry in read(audit)] == [AuditAction.APPLY_BEGUN, AuditAction.APPLIED]


@settings(max_examples=300, deadline=None)
@given(
    st.floats(1e-9, 1e9).flatmap(lambda gain: st.tuples(st.sampled_from([gain, -gain]), st.floats(1e-6, 0.5))),
    st.just("") | _numbers,
)
def test_a_gain_is_spelt_exactly_enough_for_every_reader(pair: tuple[float, float], like: str) -> None:
    gain, relative_std = pair
    std = relative_std * abs(gain)
    text = spell(gain, std, like)
    error = abs(float(text) - gain)
    # Five significant digits, and less than a hundredth of σ's first digit.
    assert error <= 0.5000001e-4 * 10.0 ** math.floor(math.log10(abs(gain)))
    assert error <= max(0.0050001 * 10.0 ** math.floor(math.log10(std)), 1e-15 * abs(gain))
    for value in (yaml.safe_load(text), YAML(typ="safe", pure=True).load(text)):
        assert isinstance(value, float)
        assert value == float(text)
    assert spell(float(text), std, like) == text
    assert text.startswith("+") == (like.startswith("+") and gain > 0)
    if "e" in like.lower():
        assert like[like.lower().index("e")] in text


@pytest.mark.parametrize(
    ("gain", "std", "like", "text"),
    [
        (33.9, 0.034, "", "33.9000"),
        (-9.2134567, 0.03, "", "-9.2135"),
        (6.79, 0.0, "", "6.7900"),
        (33912.34, 120.0, "", "33912.3"),
        (1.5e-7, 1e-9, "", "1.5000e-07"),
        (6.7912345678, 2e-6, "", "6.79123457"),
        (33.9, 0.034, "3.296e1", "3.39000e+1"),
        (33.9, 0.034, "3.296E+01", "3.39000E+01"),
        (33.9, 0.034, "+32.96", "+33.9000"),
        (-33.9, 0.034, "+32.96", "-33.9000"),
        (33.9, 0.034, "32.961234", "33.900000"),
    ],
)
def test_digits_follow_the_uncertainty_and_the_habit_of_the_file(gain: float, std: float, like: str, text: str) -> None:
    assert spell(gain, std, like) == text


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("drives: {J1: {gain: 1.0}}", "drives.J2.gain", "no key 'J2' in drives (it has J1)"),
        ("drives: {J1: {gain: 1.0}}", "drives.J1", "a list or mapping"),
        ("drives: {J1: {gain: 1.0}}", "drives.J1.gain.value", "no key 'value' in drives.J1.gain"),
        ("drives: {J1: {gain: fast}}", "drives.J1.gain", "'fast'"),
        ("drives: {J1: {gain: }}", "drives.J1.gain", "''"),
        ("drives: {J1: {gain: .nan}}", "drives.J1.gain", "'.nan'"),
        ("drives: {J1: {gain: 0x10}}", "drives.J1.gain", "'0x10'"),
        ("drives: {J1: {gain: 1_000.0}}", "drives.J1.gain", "'1_000.0'"),
        ("drives: {J1: {gain: 010}}", "drives.J1.gain", "octal to readers of YAML 1.1"),
        ("drives: {J1: {gain: '-0010'}}", "drives.J1.gain", "without leading zeros"),
        ("drives: {J1: {gain: !!int 1}}", "drives.J1.gain", "the tag !!int before it"),
        ("drives: {J1: {gain: &x !!int '1'}}", "drives.J1.gain", "the tag !!int before it"),
        ("drives: {J1: {gain: !!str 1.0}}", "drives.J1.gain", "make it !!float"),
        ("drives: {J1: {gain: ! 1.0}}", "drives.J1.gain", "the tag ! before it"),
        ("drives: {J1: {gain: !newton 1.0}}", "drives.J1.gain", "the tag !newton before it"),
        ("%TAG !! tag:example.com,2000:\n---\ng: !!float 1.0", "g", "the tag !!float before it"),
        ('drives: {J1: {gain: "\\x31.0"}}', "drives.J1.gain", "'1.0'"),
        ("drives:\n  J1:\n    gain: |\n      1.0\n", "drives.J1.gain", "1.0"),
        ("a: &g 1.0\nb: *g", "a", "shared by an anchor"),
        ("a: &g 1.0\nb: *g", "b", "shared by an anchor"),
        ("a: &j {gain: 1.0}\nb: *j", "b.gain", "shared by an anchor"),
        ("d: &j {gain: 1.0}\nb: {<<: *j, kp: 1}", "b.gain", "merges (<<)"),
        ("d: &j {gain: 1.0}\nb: {<<: *j, kp: 1}", "d.gain", "shared by an anchor"),
        ("a: {gain: 1.0, kp: 2, gain: 3.0}", "a.gain", "2 times"),
        ("a: [1.0, 2.0]", "a.2", "no key '2'"),
        ("a: [1.0", "a.0", "no YAML"),
        ("a: 1.0\n---\na: 2.0", "a", "no YAML"),
        ("", "a", "nothing in it"),
        ("# only a comment\n", "a", "nothing in it"),
        ("a: \x07", "a", "no YAML"),
        ("just text", "a", "no key 'a'"),
    ],
)
def test_a_number_that_cannot_be_changed_alone_is_refused(text: str, key: str, says: str) -> None:
    with pytest.raises(ControllerUnfit) as caught:
        YamlDocument("robot.yaml", text).locate((key,))
    assert says in str(caught.value)
    assert "robot.yaml" in str(caught.value)


@pytest.mark.parametrize(
    "text", ["g: !!float 7", "g: !<tag:yaml.org,2002:float> 7", "g: &x !!float '7'", "g: 0", "g: 0.5"]
)
def test_what_is_written_for_a_tagged_number_is_a_number_to_both_readers(text: str) -> None:
    (scalar,) = YamlDocument("robot.yaml", text).locate(("g",))
    changed = YamlDocument("robot.yaml", text).with_values({"g": scalar.spell(7.7, 0.1)}).text
    for tree in (yaml.safe_load(changed), YAML(typ="safe", pure=True).load(changed)):
        assert float(tree["g"]) == 7.7


def test_bytes_that_are_no_utf8_are_refused() -> None:
    with pytest.raises(ControllerUnfit, match="byte 5 that is not UTF-8"):
        decode_document(b"a: 1 \xff", "robot.yaml")


@pytest.mark.parametrize(
    "other",
    [
        "a: 2.5\nb: 2.0  # kept\n",  # another key changed as well
        "a: 2.5\n",  # a key lost
        "a: 2.5\nb: 1.0  # kept\nc: 1\n",  # a key more
        "a: 1.0\nb: 1.0  # kept\n",  # the key meant did not change
        "a: 2.50\nb: 1.0  # kept\n",  # spelt otherwise than shown
    ],
)
def test_the_second_look_finds_any_other_change(other: str) -> None:
    before = YamlDocument("robot.yaml", "a: 1.0\nb: 1.0  # kept\n")
    with pytest.raises(ControllerUnfit, match="another value at"):
        YamlDocument("robot.yaml", other).check_against(before, {"a": "2.5"})
    before.with_values({"a": "2.5"}).check_against(before, {"a": "2.5"})


def test_a_bomb_of_aliases_is_no_danger() -> None:
    text = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60)) + "gain: 1.0\n"
    assert "gain: 2.5000\n" in YamlDocument("robot.yaml", text).with_values({"gain": "2.5000"}).text
