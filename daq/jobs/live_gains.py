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

CONNECT_S = 5.0  #: Longest time until the feed accepts the connection
END_S = 3.0  #: Longest time for the process to end, before it is killed
NICENESS = 10  #: The recorder comes first
SHORTEST_S = 2.1  #: Duration of a block from which on its gains are estimated: the filters need it
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
        """Begin before the first block.

        Args:
            cell, payload, target_percent: see `GainsSoFar.of`.
            honest_s: motion before the first figures [s].
        """
        self._cell = cell
        self._no_blocks = replace(GainsSoFar.of(cell, payload, target_percent), honest_s=honest_s)
        self._complete_blocks = self._no_blocks
        self._complete_digests: tuple[str, ...] = ()  # of the logs of these blocks
        self._with_present_block = self._no_blocks
        self._run: RunSoFar | None = None  # None where the run is no block of a session
        self._block = BlockMove("", 0, 0)  # the present one
        self._causes: Mapping[str, str] = {}  # why each axis takes long
        self._problem = ""  # why an earlier block does not count
        self._last_packet: int | None = None  # its number
        self._moves_at_last_look = 0

    def take(self, packet: bytes) -> None:
        """Process one packet of the feed.

        Raises:
            FeedUnfit: this version does not understand it.
        """
        found = read_packet(packet, len(self._cell.axes))
        is_packet_lost = self._last_packet is not None and found.number > self._last_packet + 1
        self._last_packet = found.number
        # The message first: it may begin the run that the samples of this packet belong to.
        if found.message is not None:
            if found.message.run is not None:
                self._begin(found.message.run)
            for event in found.message.events:
                self._take_event(event)
        if self._run is None:
            return
        if is_packet_lost:
            self._run.is_whole = False
        if found.rows is not None:
            self._run.take(found.rows)

    def look(self) -> QuickLook | None:
        """Return a look at the gains if a move was finished since the last one; else None."""
        run = self._run
        if run is None or run.finished_moves == self._moves_at_last_look:
            return None
        self._moves_at_last_look = run.finished_moves
        block = replace(self._block, move=run.finished_moves)
        if self._problem:
            return self._without_gains(block, self._problem)
        if block.is_held_out:
            return self._complete_blocks.look(block, self._causes)
        if not run.is_whole:
            return self._without_gains(block, LOST)
        return self._look_at_present(run, block)

    def _without_gains(self, block: BlockMove, missing: str) -> QuickLook:
        """Return a look that says why there are no gains."""
        return QuickLook(
            block.block,
            block.move,
            block.moves,
            self._complete_blocks.motion_s,
            block.is_held_out,
            missing=missing,
        )

    def _look_at_present(self, run: RunSoFar, block: BlockMove) -> QuickLook | None:
        """Fold in the present block as far as it is recorded, and look at the gains.

        Returns:
            The look; None while the block is too short for the filters.
        """
        so_far = run.run()
        if so_far is None or so_far.time_s[-1] < SHORTEST_S:
            return None
        try:
            self._with_present_block = self._with_present_block.with_run(so_far, is_complete=False)
            # Of the run, only what is new is folded in. Its motion is added as a whole: it is not
            # stored, or it would count once for each look.
            with_motion = self._with_present_block.with_motion(so_far)
            return with_motion.look(block, self._causes)
        except IdentificationError as error:
            return self._without_gains(block, str(error))

    def _take_event(self, event: CellEvent) -> None:
        if self._run is None:
            return
        self._run.take_event(event)
        if event.kind is EventKind.MOVE_END:
            self._run.finished_moves += 1

    def _begin(self, facts: RunFacts) -> None:
        """Begin a run; it is watched if it is a block of a session."""
        self._run = None
        self._moves_at_last_look = 0
        self._problem = ""
        if facts.log is None:
            return
        log = Path(facts.log)
        session_folder = log.parent
        state = self._state_of(session_folder)
        if state is None:
            return
        blocks = {block.name: block for block in state.blocks}
        present = blocks.get(log.stem)
        if present is None:
            return
        self._run = RunSoFar(self._cell, facts, present.name)
        self._block = BlockMove(present.name, 0, facts.moves, present.holdout)
        self._causes = {gain.axis: gain.cause for gain in state.gains}
        names_by_digest: dict[str, str] = {}
        for run in state.runs:
            block = blocks.get(run.name)
            if block is not None and not block.holdout:
                names_by_digest[run.sha256] = run.name
        try:
            self._fold_complete(session_folder, names_by_digest)
        except (DaqError, IdentificationError) as error:
            self._problem = f"an earlier block cannot be used: {error}"
        # σ of the last search belongs to the blocks that it has seen, and to no others.
        self._complete_blocks = replace(self._complete_blocks, scale=None)
        if state.gains and state.judged_blocks == len(state.runs):
            std_percent = np.array([gain.std_percent for gain in state.gains])
            self._complete_blocks = self._complete_blocks.in_proportion(std_percent)
        self._with_present_block = self._complete_blocks

    def _state_of(self, folder: Path) -> GuidedState | None:
        """Return the state of the guided session in a folder; None if none is there."""
        for session in sessions(folder.parent, self._cell.name):
            if session.folder == folder and isinstance(session.state, GuidedState):
                return session.state
        return None

    def _fold_complete(self, folder: Path, names_by_digest: Mapping[str, str]) -> None:
        """Fold the complete blocks of a session into their fit.

        A block that is folded in cannot be taken out: where the log of one has gone or is another,
        all are folded in again.

        Args:
            folder: of the session, with the logs.
            names_by_digest: names of the blocks that count, by the digests of their logs.

        Raises:
            DaqError, IdentificationError: a block cannot be used; those before it are folded in.
        """
        is_any_gone = any(digest not in names_by_digest for digest in self._complete_digests)
        if is_any_gone:
            self._complete_blocks = self._no_blocks
            self._complete_digests = ()
        for digest, name in names_by_digest.items():
            if digest in self._complete_digests:
                continue
            run, _ = load_run(folder / f"{name}.mcap", self._cell)
            self._complete_blocks = self._complete_blocks.with_run(run).with_motion(run)
            self._complete_digests = (*self._complete_digests, digest)


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

    Args:
        connection: to the feed; an empty packet is its end.
        watch: takes the packets.
        report: receives each look.

    Raises:
        FeedUnfit: a packet is of another version.
    """
    while True:
        connection.setblocking(True)
        packet = connection.recv(LARGEST_PACKET)
        # Read all that waits before the look: an estimate takes longer than a packet.
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
            target=self._show_looks, args=(self._process,), name="live gains", daemon=True
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

    def _show_looks(self, process: subprocess.Popen[str]) -> None:
        """Show each look that the process prints, and its end if the session did not end it."""
        assert process.stdout is not None
        for line in process.stdout:
            self._show(_LOOK.validate_json(line))
        code = process.wait()
        # It ends with the feed, or by the signal of `__exit__`.
        if code not in (0, -signal.SIGTERM):
            self._show(QuickLook("", 0, 0, 0.0, missing=ENDED.format(code=code)))


def main(arguments: list[str]) -> int:
    """Follow the feed of a cell file, and print each look as a line of JSON.

    Args:
        arguments: those of `LiveGains`, as text.

    Returns:
        The exit code: 1 where there is no feed, or one that cannot be read.
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
