"""Show the gains after each move of a guided session, without ever delaying the recording.

A process of its own connects to the feed of the recorder, as a console does: the recorder never
waits for it, and drops what it does not read. It folds the blocks that the session has recorded,
and the samples of the present one, into the triangles of a growing fit, and prints a look at the
gains after each move as a line of JSON. A thread of the session waits for these lines.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType

import numpy as np
from pydantic import TypeAdapter

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.session_state import GuidedState
from daq.errors import DaqError
from daq.jobs.session import sessions
from daq.log.conversion import load_run
from daq.log.feed import (
    LARGEST_PACKET,
    FeedUnfit,
    QuickLook,
    RunFacts,
    connected,
    read_packet,
    socket_names,
)
from daq.workflow.quick_look import HONEST_S, BlockMove, GainsSoFar, RunSoFar
from drivers.messages import CellEvent, EventKind
from ident.errors import IdentificationError

CONNECT_S = 5.0  #: Time for the feed to accept
END_S = 3.0  #: Time for the process to end
NICENESS = 10  #: The recorder comes first
SHORTEST_S = 2.1  #: Of a block before it is looked at: the filters need that
LOST = (
    "samples of this block were not seen in time; its log has them, and they count when it "
    "is complete"
)
ENDED = (
    "the process that estimates them after each move has ended (exit code {code}); the session "
    "goes on without it"
)
_LOOK = TypeAdapter(QuickLook)


class BlockWatch:
    """Follows the blocks of a session by the packets of the feed."""

    def __init__(
        self, cell: Cell, payload: str, target_percent: float, honest_s: float = HONEST_S
    ) -> None:
        """Begin before the first block; see `GainsSoFar` for the arguments."""
        self._cell = cell
        self._nothing = replace(GainsSoFar.of(cell, payload, target_percent), honest_s=honest_s)
        self._recorded = self._nothing  # blocks that are complete
        self._folded: tuple[str, ...] = ()  # digests of their logs
        self._growing = self._nothing  # with the present block
        self._run: RunSoFar | None = None  # None where the run is no block of a session
        self._place = BlockMove("", 0, 0)
        self._causes: Mapping[str, str] = {}
        self._problem = ""
        self._number: int | None = None
        self._looked = 0  # finished moves at the last look

    def take(self, packet: bytes) -> None:
        """Process one packet of the feed.

        Raises:
            FeedUnfit: this version does not understand it.
        """
        found = read_packet(packet, len(self._cell.axes))
        has_gap = self._number is not None and found.number > self._number + 1
        self._number = found.number
        if found.message is not None:
            if found.message.run is not None:
                self._begin(found.message.run)
            for event in found.message.events:
                self._take_event(event)
        if self._run is None:
            return
        if has_gap:
            self._run.is_whole = False
        if found.rows is not None:
            self._run.take(found.rows)

    def look(self) -> QuickLook | None:
        """Return a look at the gains if a move was finished since the last one; else None."""
        run = self._run
        if run is None or run.finished_moves == self._looked:
            return None
        self._looked = run.finished_moves
        place = replace(self._place, move=run.finished_moves)
        nothing = QuickLook(
            place.block, place.move, place.moves, self._recorded.motion_s, place.is_held_out
        )
        problem = self._problem
        if not run.is_whole and not place.is_held_out:
            problem = problem or LOST
        if problem:
            return replace(nothing, missing=problem)
        if place.is_held_out:
            return self._recorded.look(place, self._causes)
        return self._look_at_growing(run, place, nothing)

    def _look_at_growing(
        self, run: RunSoFar, place: BlockMove, nothing: QuickLook
    ) -> QuickLook | None:
        """Fold in the present block as far as it is recorded;
        None before it is long enough for the filters.
        """
        samples = run.run()
        if samples is None or samples.time_s[-1] < SHORTEST_S:
            return None
        try:
            self._growing = self._growing.with_run(samples, is_complete=False)
            return self._growing.with_motion(samples).look(place, self._causes)
        except IdentificationError as error:
            return replace(nothing, missing=str(error))

    def _take_event(self, event: CellEvent) -> None:
        if self._run is None:
            return
        self._run.take_event(event)
        if event.kind is EventKind.MOVE_END:
            self._run.finished_moves += 1

    def _begin(self, facts: RunFacts) -> None:
        """Begin a run; it is watched if it is a block of a session."""
        self._run = None
        self._looked = 0
        self._problem = ""
        if facts.log is None:
            return
        log = Path(facts.log)
        state = self._state_in(log.parent)
        if state is None:
            return
        blocks = {block.name: block for block in state.blocks}
        block = blocks.get(log.stem)
        if block is None:
            return
        self._run = RunSoFar(self._cell, facts, block.name)
        self._place = BlockMove(block.name, 0, facts.moves, block.holdout)
        self._causes = {gain.axis: gain.cause for gain in state.gains}
        counted = {name for name, other in blocks.items() if not other.holdout}
        digests = {run.sha256: run.name for run in state.runs if run.name in counted}
        try:
            self._fold(log.parent, digests)
        except (DaqError, IdentificationError) as error:
            self._problem = f"an earlier block cannot be used: {error}"
        self._recorded = replace(self._recorded, scale=None)
        if state.gains and state.judged_blocks == len(state.runs):
            std_percent = np.array([gain.std_percent for gain in state.gains])
            self._recorded = self._recorded.in_proportion(std_percent)
        self._growing = self._recorded

    def _state_in(self, folder: Path) -> GuidedState | None:
        for session in sessions(folder.parent, self._cell.name):
            if session.folder == folder and isinstance(session.state, GuidedState):
                return session.state
        return None

    def _fold(self, folder: Path, digests: Mapping[str, str]) -> None:
        """Fold in the logs of complete blocks, by their digests;
        begin anew where one of them has gone.
        """
        if not set(self._folded) <= set(digests):
            self._recorded = self._nothing
            self._folded = ()
        for digest, name in digests.items():
            if digest in self._folded:
                continue
            run, _ = load_run(folder / f"{name}.mcap", self._cell)
            self._recorded = self._recorded.with_run(run).with_motion(run)
            self._folded = (*self._folded, digest)


def tells_something_new(look: QuickLook, before: QuickLook | None) -> bool:
    """Whether a person has not read this look:
    figures change with each move, what is missing does not.

    Figures during a held-out block are those of before it.
    """
    if before is None:
        return True
    if look.is_held_out:
        return False
    if look.gains:
        return True
    return look.missing != before.missing


def follow_feed(
    connection: socket.socket, watch: BlockWatch, report: Callable[[QuickLook], None]
) -> None:
    """Read packets until the feed ends; look at the gains where nothing more waits to be read.

    Raises:
        FeedUnfit: a packet is of another version.
    """
    while True:
        connection.setblocking(True)
        packet = connection.recv(LARGEST_PACKET)
        connection.setblocking(False)
        while packet:
            watch.take(packet)
            try:
                packet = connection.recv(LARGEST_PACKET)
            except BlockingIOError:
                break
        if not packet:
            return
        look = watch.look()
        if look is not None:
            report(look)


class LiveGains:
    """Context manager that runs the process, and passes its looks on from a thread of its own."""

    def __init__(
        self,
        cell_file: Path,
        payload: str,
        target_percent: float,
        show: Callable[[QuickLook], None],
    ) -> None:
        """Store the arguments.

        Args:
            cell_file: of the cell, whose feed is open already.
            payload: name of the body for the loaded blocks.
            target_percent: σ that every gain shall reach [%].
            show: receives each look, in another thread.
        """
        self._arguments = (str(cell_file), payload, repr(target_percent))
        self._show = show
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> LiveGains:
        """Start the process; without it a session goes on,
        and shows no gains between two blocks.
        """
        # Not this folder's modules, and no Ctrl-C of the terminal: the process ends with the feed.
        command = [sys.executable, "-P", "-m", __name__, *self._arguments]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,
            )
        except OSError:
            return self
        self._thread = threading.Thread(
            target=self._wait, args=(self._process,), name="live gains", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._process is None or self._thread is None:
            return
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join(END_S)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _wait(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._show(_LOOK.validate_json(line))
        code = process.wait()
        if code not in (0, -signal.SIGTERM):
            self._show(QuickLook("", 0, 0, 0.0, missing=ENDED.format(code=code)))


def main(arguments: list[str]) -> int:
    """Follow the feed of a cell file, and print each look as a line of JSON;
    1 where there is no feed.
    """
    cell_file, payload, target_percent = arguments
    os.nice(NICENESS)
    path = Path(cell_file)
    watch = BlockWatch(load_cell(path), payload, float(target_percent))
    connection = connected(socket_names(path).feed, socket.SOCK_SEQPACKET, CONNECT_S)
    if connection is None:
        return 1

    def report(look: QuickLook) -> None:
        sys.stdout.write(json.dumps(asdict(look)) + "\n")
        sys.stdout.flush()

    with connection:
        try:
            follow_feed(connection, watch, report)
        except (FeedUnfit, OSError):
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
