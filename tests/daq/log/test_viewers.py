"""A log decoded as Foxglove and PlotJuggler decode it:
by the definitions inside it, with software that is not ours.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from drivers.messages import CellEvent, EventKind
from tests.daq.logs import START_NS, demo_content, rising_counts, samples, write

VIEWERS = Path(__file__).parents[3] / "configs" / "viewers"
AXES = 6
ROWS = 60


@pytest.fixture(scope="module")
def decoded(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> dict[str, list[Any]]:
    """Messages of a log by topic."""
    event = CellEvent(START_NS, 2, EventKind.EMCY, 0x8611, "node 3: following error")
    rows = samples(rising_counts(ROWS, AXES))
    path = tmp_path_factory.mktemp("log") / "bare.mcap"
    log = write(path, demo_content(checkout), rows, [event])
    messages: dict[str, list[Any]] = defaultdict(list)
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _schema, channel, _message, content in reader.iter_decoded_messages():
            messages[channel.topic].append(content)
    return dict(messages)


def test_the_messages_are_those_that_were_written(decoded: dict[str, list[Any]]) -> None:
    expected = {
        "/cell/samples",
        "/cell/events",
        "/joint_states",
        "/cell/currents",
        "/robot_description",
    }
    assert set(decoded) == expected
    position_counts = [list(message.position_counts) for message in decoded["/cell/samples"]]
    assert position_counts == rising_counts(ROWS, AXES)
    first = decoded["/cell/samples"][0]
    found = first.stamp.sec * 10**9 + first.stamp.nanosec
    assert found == START_NS
    (event,) = decoded["/cell/events"]
    assert event.axis == 2
    assert event.kind == "emcy"
    assert event.code == 0x8611
    assert event.text == "node 3: following error"
    first_joint_state = decoded["/joint_states"][0]
    assert list(first_joint_state.name) == [f"J{number}" for number in range(1, AXES + 1)]


def _foxglove_paths() -> list[str]:
    text = (VIEWERS / "foxglove.json").read_text(encoding="utf-8")
    layout = json.loads(text)
    found = []
    for panel in layout["configById"].values():
        layers = panel.get("layers", {}).values()
        topics = [layer["topic"] for layer in layers if "topic" in layer]
        found += topics + list(panel.get("topics", ()))
        panels = [panel[key] for key in ("topicPath",) if key in panel]
        paths = panel.get("paths", ())
        found += [path["value"] for path in paths] + panels
    return found


def _plotjuggler_curves() -> list[str]:
    root = ElementTree.parse(VIEWERS / "plotjuggler.xml").getroot()
    return [curve.attrib["name"] for curve in root.iter("curve")]


@pytest.mark.parametrize("path", _foxglove_paths())
def test_every_path_of_the_foxglove_layout_leads_to_something(
    decoded: dict[str, list[Any]], path: str
) -> None:
    topic, _, rest = path.partition(".")
    # Of the live stream alone, in messages of one type
    if topic in ("/cell/predicted", "/cell/residual"):
        topic = "/cell/currents"
    steps = re.findall(r"\w+|\[\d+\]", rest)
    assert _walk(decoded[topic][0], steps) is not None


@pytest.mark.parametrize("curve", _plotjuggler_curves())
def test_every_curve_of_the_plotjuggler_layout_is_a_number(
    decoded: dict[str, list[Any]], curve: str
) -> None:
    """A curve is topic, slash, fields; PlotJuggler spreads a JointState out by the names of its
    joints.
    """
    topic = next(topic for topic in decoded if curve.startswith(f"{topic}/"))
    steps = re.findall(r"\w+|\[\d+\]", curve.removeprefix(topic))
    message = decoded[topic][0]
    if topic == "/joint_states":
        joint, quantity = steps
        steps = [quantity, f"[{list(message.name).index(joint)}]"]
    assert isinstance(_walk(message, steps), int | float)


def _walk(value: Any, steps: list[str]) -> Any:
    for step in steps:
        if step.startswith("["):
            value = value[int(step[1:-1])]
        else:
            value = getattr(value, step)
    return value


def test_every_panel_of_the_foxglove_layout_is_placed_once() -> None:
    text = (VIEWERS / "foxglove.json").read_text(encoding="utf-8")
    layout = json.loads(text)

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        return leaves(node["first"]) + leaves(node["second"])

    orders = leaves(layout["layout"])
    assert sorted(orders) == sorted(layout["configById"])


def test_the_layouts_show_all_axes_and_nothing_twice() -> None:
    for named, samples_of in (
        (_foxglove_paths(), "/cell/samples."),
        (_plotjuggler_curves(), "/cell/samples/"),
    ):
        plotted = [name for name in named if "[" in name]
        assert len(set(plotted)) == len(plotted)
        for field in ("position_counts", "current_raw", "statusword"):
            assert {f"{samples_of}{field}[{axis}]" for axis in range(AXES)} <= set(named)
