"""The controller's YAML file: only the numbers meant change,
whatever a human has made of the rest.
"""

from __future__ import annotations

import math

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from daq.errors import ControllerUnfit
from daq.formats.document import decode_document
from daq.formats.scalar import spell
from daq.formats.yaml_document import YamlDocument, yaml_document
from tests.daq.formats.yaml_cases import NUMBERS, Case, cases


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(cases(), st.data())
def test_only_theNUMBERS_meant_change(case: Case, data: st.DataObject) -> None:
    gains = data.draw(
        st.lists(
            st.floats(-1e4, 1e4).filter(lambda gain: abs(gain) > 1e-3),
            min_size=len(case.keys),
            max_size=len(case.keys),
        )
    )
    content = case.text(case.numbers).encode()
    file = decode_document(content, "robot.yaml")
    found = file.locate(case.keys)
    texts = [scalar.text for scalar in found]
    assert texts == list(case.numbers)
    expected = [float(number) for number in case.numbers]
    assert [scalar.value for scalar in found] == expected

    spelt = tuple(
        spell(gain, 0.003 * abs(gain), number)
        for gain, number in zip(gains, case.numbers, strict=True)
    )
    spelling = dict(zip(case.keys, spelt, strict=True))
    changed = file.with_values(spelling)

    assert changed.text == case.text(spelt)
    assert [scalar.text for scalar in changed.locate(case.keys)] == list(spelt)
    assert file.with_values({}).text == file.text


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    st.floats(1e-9, 1e9).flatmap(
        lambda gain: st.tuples(st.sampled_from([gain, -gain]), st.floats(1e-6, 0.5))
    ),
    st.just("") | NUMBERS,
)
def test_a_gain_is_spelt_exactly_enough_for_every_reader(
    pair: tuple[float, float], like: str
) -> None:
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
def test_digits_follow_the_uncertainty_and_the_habit_of_the_file(
    gain: float, std: float, like: str, text: str
) -> None:
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
        ("a: [1.0, 2.0]", "a.2", "no key '2' in a (it has 0, 1)"),
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


@pytest.mark.parametrize(("text", "value"), [("032.96", 32.96), ("-010.5", -10.5), ("0.5", 0.5)])
def test_a_leading_zero_before_a_decimal_point_changes_no_number(text: str, value: float) -> None:
    """Of whole numbers alone readers differ: `034` is octal to some."""
    (scalar,) = YamlDocument("robot.yaml", f"g: {text}").locate(("g",))
    assert scalar.value == value
    assert float(yaml.safe_load(f"g: {text}")["g"]) == value


@pytest.mark.parametrize(
    "text",
    ["g: !!float 7", "g: !<tag:yaml.org,2002:float> 7", "g: &x !!float '7'", "g: 0", "g: 0.5"],
)
def test_what_is_written_for_a_tagged_number_is_a_number_to_both_readers(text: str) -> None:
    (scalar,) = YamlDocument("robot.yaml", text).locate(("g",))
    spelling = {"g": scalar.spell(7.7, 0.1)}
    changed = YamlDocument("robot.yaml", text).with_values(spelling).text
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
    text = (
        "a0: &a0 [x, x]\n"
        + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
        + "gain: 1.0\n"
    )
    assert "gain: 2.5000\n" in YamlDocument("robot.yaml", text).with_values({"gain": "2.5000"}).text


@pytest.mark.parametrize("gap", ["\t", " \t", "\t\t ", " \t \t"])
@pytest.mark.parametrize("behind", ["# Nm/A", ""])
def test_tabs_behind_a_number_are_read_and_stay(gap: str, behind: str) -> None:
    text = f"J1:\n  gain: 32.96{gap}{behind}\nJ2:\n  gain: -11.52 # tab\tinside\n"
    document = yaml_document(text.encode(), "controller.yaml")
    assert [one.value for one in document.locate(("J1.gain", "J2.gain"))] == [32.96, -11.52]
    expected = text.replace("32.96", "33.10")
    assert document.with_values({"J1.gain": "33.10"}).text == expected


@pytest.mark.parametrize("gap", ["\t", " \t", "\t\t ", " \t \t"])
def test_tabs_between_a_key_and_its_number_are_read_and_stay(gap: str) -> None:
    text = f"J1:\n  gain:{gap}32.96\nJ2: {{gain:{gap}-11.52}}\n"
    document = decode_document(text.encode(), "robot.yaml")
    scalars = [scalar.value for scalar in document.locate(("J1.gain", "J2.gain"))]
    assert scalars == [32.96, -11.52]
    changed = document.with_values({"J1.gain": "33.5000"})
    expected = text.replace("32.96", "33.5000").encode()
    assert changed.content == expected


def test_a_tab_that_indents_is_still_no_yaml() -> None:
    with pytest.raises(ControllerUnfit, match="no YAML"):
        yaml_document(b"J1:\n\tgain: 32.96\n", "controller.yaml").locate(("J1.gain",))
