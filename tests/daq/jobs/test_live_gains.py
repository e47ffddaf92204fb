"""The gains while a block of a guided session is recorded:
by a process of its own, which reads the feed.
"""

from __future__ import annotations

import json
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from daq.documents.session_state import GuidedState
from daq.jobs.live_gains import LOST, BlockWatch, LiveGains, follow_feed, tells_something_new
from daq.jobs.session import Session, save
from daq.log.conversion import scaling
from daq.log.feed import HEAD, TEXT, Feed, QuickGain, QuickLook, RunFacts
from daq.log.metadata import RunStatistics
from daq.log.reader import Log, read_log
from drivers.messages import CellEvent, EventKind, Sample
from tests.daq.console.feeds import arrivals
from tests.daq.jobs.made_session import TARGET_PERCENT, MadeSession
from tests.daq.jobs.rig import Rig

LOOK = QuickLook("block-2-loaded", 3, 9, 31.0)
FIGURES = replace(LOOK, gains=[QuickGain("J1", "Nm/A", 33.9, 0.4, 0.5)])


@dataclass(frozen=True)
class Recorded:
    """A session folder as it was while a block was recorded."""

    rig: Rig
    folder: Path
    block: str

    @property
    def log(self) -> Log:
        """What was recorded then."""
        path = self.folder / f"{self.block}.mcap"
        return read_log(path)

    @property
    def facts(self) -> RunFacts:
        """As the recorder published them."""
        log = self.log
        scale = scaling(self.rig.cell, log.head.readback)
        moves = sum(event.kind is EventKind.MOVE_END for event in log.events)
        axes = self.rig.cell.axis_names
        rate_hz = log.head.run.rate_hz
        rad_per_count = scale.rad_per_count.tolist()
        current_per_unit = scale.current_per_unit.tolist()
        to_joint = scale.to_joint.tolist()
        offset_rad = scale.offset_rad.tolist()
        payload = None if log.head.run.payload is None else log.head.run.payload.name
        return RunFacts(
            run_id="id",
            log=str(self.folder / f"{self.block}.mcap"),
            axes=axes,
            rate_hz=rate_hz,
            moves=moves,
            rad_per_count=rad_per_count,
            current_per_unit=current_per_unit,
            to_joint=to_joint,
            offset_rad=offset_rad,
            payload=payload,
            bus_load={},
        )

    def publish(self, feed: Feed, every: int = 1) -> None:
        """Publish the block as its recorder did: samples and events in the order of time.

        Args:
            feed: of the cell.
            every: leaves out samples but each so many.
        """
        log = self.log
        rows = log.samples
        feed.begin(self.facts, lambda: RunStatistics(len(rows.cycle), 0, (), valid=True))
        events = list(log.events)
        for number in range(0, len(rows.cycle), every):
            time_ns = int(rows.time_ns[number])
            while events and events[0].time_ns < time_ns:
                feed.event(events.pop(0))
            position_counts = tuple(rows.position_counts[number].tolist())
            current_raw = tuple(rows.current_raw[number].tolist())
            statusword = tuple(rows.statusword[number].tolist())
            cycle = int(rows.cycle[number])
            sample = Sample(cycle, time_ns, position_counts, current_raw, statusword)
            feed.sample(sample)
        for event in events:
            feed.event(event)
        feed.finish()


class Packets(Feed):
    """A feed whose packets are kept in a list."""

    def __init__(self, cell_file: Path) -> None:
        super().__init__(cell_file)
        self.sent: list[bytes] = []
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._consoles.append(pair[0])
        self._kept = pair

    def _put(self, console: socket.socket, packet: bytes) -> None:
        self.sent.append(packet)

    def close(self) -> None:
        """Close the sockets."""
        for one in self._kept:
            one.close()


def while_recording(whole_session: tuple[Rig, MadeSession], folder: Path, block: str) -> Recorded:
    """A copy of a real session as it was during a block."""
    rig, _ = whole_session
    session = rig.session
    state = session.state
    assert isinstance(state, GuidedState)
    names = [one.name for one in state.blocks]
    before = names[: names.index(block)]
    runs = tuple(run for run in state.runs if run.name in before)
    blocks = tuple(one for one in state.blocks if one.name in (*before, block))
    update = {
        "blocks": blocks,
        "runs": runs,
        "gains": (),
        "outcome": None,
        "ended": None,
    }
    then = state.model_copy(update=update)
    copy = folder / session.folder.name
    shutil.copytree(session.folder, copy)
    save(Session(copy, then))
    return Recorded(rig, copy, block)


def looks_at(recorded: Recorded, *, every: int = 1, gap: bool = False) -> list[QuickLook]:
    """All looks at a block while its packets come."""
    watch = BlockWatch(recorded.rig.cell, "disc", TARGET_PERCENT, honest_s=0.0)
    packets = Packets(recorded.rig.cell_file)
    recorded.publish(packets, every)
    packets.close()
    if gap:
        del packets.sent[len(packets.sent) // 2]
    found = []
    for packet in packets.sent:
        watch.take(packet)
        look = watch.look()
        if look is not None:
            found.append(look)
    return found


def test_a_bare_block_alone_gives_no_figures(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-1-bare")
    looks = looks_at(recorded)
    assert looks
    assert not any(look.gains for look in looks)
    assert {look.missing.split(",")[0] for look in looks} == {"the gains need a known mass"}


def test_the_gains_come_while_the_loaded_block_is_recorded(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-2-loaded")
    looks = looks_at(recorded)
    moves = [look.move for look in looks]
    assert moves == sorted(set(moves))
    last_move = moves[-1]
    assert last_move == recorded.facts.moves == looks[-1].moves
    last = looks[-1]
    assert last.missing == ""
    assert last.why
    gains = whole_session[1].calibration.gains
    true = {gain.axis: gain for gain in gains}
    for gain in last.gains:
        std = true[gain.axis].std
        allowed = 4.0 * (0.01 * gain.std_percent * abs(gain.value) + std)
        assert gain.value == pytest.approx(true[gain.axis].value, abs=allowed), gain.axis
        assert gain.target_percent == TARGET_PERCENT


def test_the_moves_of_a_held_out_block_do_not_count(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-3-held-out")
    looks = looks_at(recorded)
    assert all(look.is_held_out for look in looks)
    texts = {json.dumps(asdict(look)["gains"]) for look in looks}
    assert len(texts) == 1
    assert looks[0].gains


def test_lost_samples_are_said_and_give_no_figures(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-2-loaded")
    looks = looks_at(recorded, gap=True)
    assert looks[-1].missing == LOST
    assert not looks[-1].gains


def test_a_run_that_is_no_block_is_not_watched(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-1-bare")
    log = str(recorded.folder / "acceptance.mcap")
    facts = asdict(replace(recorded.facts, log=log))
    watch = BlockWatch(recorded.rig.cell, "disc", TARGET_PERCENT)
    cell_event = CellEvent(1, None, EventKind.MOVE_END, 0, "")
    end = {
        **asdict(cell_event),
        "kind": EventKind.MOVE_END.value,
    }
    for message in ({"run": facts}, {"events": [end]}):
        watch.take(HEAD.pack(TEXT, 0, 0, 0, 0, 0) + json.dumps(message).encode())
    assert watch.look() is None


def test_an_earlier_block_that_cannot_be_read_is_named(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-2-loaded")
    (recorded.folder / "block-1-bare.mcap").write_bytes(b"damaged")
    last_look = looks_at(recorded)[-1]
    assert "an earlier block cannot be used" in last_look.missing


def test_a_look_is_said_once_unless_it_has_new_figures() -> None:
    waiting = replace(LOOK, missing="no payload")
    assert tells_something_new(waiting, None)
    look = replace(waiting, move=4)
    assert not tells_something_new(look, waiting)
    changed_waiting = replace(waiting, block="block-3")
    assert not tells_something_new(changed_waiting, waiting)
    changed_waiting_look = replace(waiting, missing="no moves")
    assert tells_something_new(changed_waiting_look, waiting)
    assert tells_something_new(FIGURES, waiting)
    changed_figure = replace(FIGURES, move=4)
    assert tells_something_new(changed_figure, FIGURES)
    changed_figure_look = replace(FIGURES, move=4, is_held_out=True)
    assert not tells_something_new(changed_figure_look, FIGURES)
    held_out = replace(FIGURES, is_held_out=True)
    changed_held_out = replace(held_out, move=4)
    assert not tells_something_new(changed_held_out, held_out)


def test_the_process_ends_with_its_feed(whole_session: tuple[Rig, MadeSession]) -> None:
    """It reads until the end, also where nothing was recorded."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.close()
    with theirs:
        cell = whole_session[0].cell
        watch = BlockWatch(cell, "disc", TARGET_PERCENT)
        follow_feed(theirs, watch, _unexpected)


def _unexpected(look: QuickLook) -> None:
    raise AssertionError(look)


@contextmanager
def live(
    recorded: Recorded, cell_file: Path
) -> Iterator[tuple[Feed, list[QuickLook], threading.Event]]:
    """A feed with the process that watches it."""
    looks: list[QuickLook] = []
    came = threading.Event()

    def show(look: QuickLook) -> None:
        looks.append(look)
        came.set()

    feed = Feed(cell_file)
    accepted = arrivals(feed)
    with feed, LiveGains(cell_file, "disc", TARGET_PERCENT, show):
        assert accepted.wait(120.0)
        yield feed, looks, came


@pytest.mark.processes
def test_the_process_prints_a_look_after_a_move(
    whole_session: tuple[Rig, MadeSession], tmp_path: Path
) -> None:
    recorded = while_recording(whole_session, tmp_path, "block-1-bare")
    with live(recorded, recorded.rig.cell_file) as (feed, looks, came):
        recorded.publish(feed)
        assert came.wait(120.0)
    assert looks[0].block == "block-1-bare"
    assert looks[0].missing


def test_a_look_of_another_thread_is_published_with_the_next_samples(tmp_path: Path) -> None:
    cell_file = tmp_path / "cell.yaml"
    packets: Any = Packets(cell_file)
    facts = RunFacts("id", None, ("J1",), 50.0, 1, [1.0], [1.0], [[1.0]], [0.0], None, {})
    packets.begin(facts, lambda: RunStatistics(0, 0, (), valid=True))
    thread = threading.Thread(target=packets.look, args=(FIGURES,))
    thread.start()
    thread.join()
    sent_before = len(packets.sent)
    sample = Sample(0, 0, (0,), (0,), (0,))
    packets.sample(sample)
    texts = [json.loads(one[HEAD.size :]) for one in packets.sent[sent_before:] if one[0] == TEXT]
    expected = [{"quick": asdict(FIGURES)}]
    assert texts == expected
    packets.sample(Sample(1, 1, (0,), (0,), (0,)))
    found = sum(one[0] == TEXT for one in packets.sent[sent_before:])
    assert found == 1
    packets.close()
