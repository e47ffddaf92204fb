"""Record one run: make the moves of a plan, and log every sample."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from daq.config import cell as declared
from daq.config.cell import Cell, joint_names
from daq.config.cell_buses import (
    bus_loads,
    cell_address,
    drive_axes,
    load_warnings,
    polling_fits,
    polling_warnings,
)
from daq.config.cell_file import bundle, bundle_digest
from daq.config.drive import shipped_profiles
from daq.config.policy import Permission
from daq.environment import software
from daq.errors import ConfigurationInconsistent, ControllerUnfit, DiskSpaceShort
from daq.files import sha256
from daq.formats.document import read_controller_file
from daq.log.conversion import SiScaling, scaling
from daq.log.feed import Feed, RunFacts
from daq.log.metadata import Loss, RunInfo, RunStatistics, loss_reason, readback_of_drives
from daq.log.motion import RecordedMotion
from daq.log.writer import LogContent, LogWriter
from daq.workflow.experiment import limits_of, path_of
from daq.workflow.interlock import release_check
from daq.workflow.nameplates import check_nameplates, nameplate_warnings
from daq.workflow.on_time import on_time
from daq.workflow.plan import Plan, check_return, way_to_first_target
from daq.workflow.safeguards import (
    DiskRoom,
    FreeBytes,
    check_entered_mass,
    free_bytes,
    largest_log_bytes,
)
from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from drivers.canopen.scale import ScaleReading
from drivers.errors import BusError, MotionRefused
from drivers.messages import CellEvent, EventKind, Sample
from drivers.motion.execute import execute
from drivers.move import AxisLimits, MotionPermission, Move, check_moves, synchronised_move
from drivers.stream.answers import StreamStatistics
from drivers.stream.polling import Polling
from drivers.stream.producers import DriveProducer, KernelProducer, SyncProducer
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync, Pacing, TimedSync
from ident.arrays import FloatArray
from ident.model.bodies import Payload

#: Time for all answers to a SYNC; a simulated cell on a busy machine may be that late
LOCKSTEP_TIMEOUT_S = 3.0
GUARD_MS = {declared.PacingMode.TIMED: 500, declared.PacingMode.LOCKSTEP: 5000}
"""Silence of the recorder after which the amplifiers stop;
in lockstep nothing moves while the recorder is late.
"""
#: Silence of the SYNC producer after which this program sends SYNC to stop the axes
SYNC_SILENCE_S = 0.1
SYNC_SILENCE_PERIODS = 3  #: The same in periods; the longer counts
ALLOWANCE_S = 10.0
"""Time added to moves and dwells for enabling, hand-shakes, settling and the stop;
a good run takes less.
"""
LATE_LOSSES_S = 0.25
"""Time to read on after the last sample:
the interface's counters are read five times a second (capture.py).
"""
LATEST_ANSWERS_S = 0.1  #: Time in which a cell has answered the last SYNC, even if it is late
SPACE_CHECK_S = 0.1  #: Recorded time between two checks of the free space on the disk
SLOW_DISK_S = 1.0  #: Longest time for which a part of the log may wait for the disk unremarked
ROUNDING = 1.001
"""Factor by which a motor's limits are above the joints':
drives take whole counts only, and a move at the limit is rounded up.
"""
LEAST_PER_S = 3.0
"""Least limits of velocity and acceleration with which `synchronised_move` can plan
[counts/s, counts/s²].
"""


@dataclass(frozen=True, slots=True)
class Clocks:
    """Clocks of a recording [ns]."""

    wall_ns: Callable[[], int] = time.time_ns
    monotonic_ns: Callable[[], int] = time.monotonic_ns

    def wall_minus_monotonic_ns(self) -> int:
        """Return the present offset of the two [ns];
        the monotonic clock is read before and after the other.
        """
        before_ns = self.monotonic_ns()
        wall_ns = self.wall_ns()
        after_ns = self.monotonic_ns()
        return wall_ns - (before_ns + after_ns) // 2

    def now(self) -> datetime:
        """Return the time of the wall clock, in UTC."""
        return datetime.fromtimestamp(self.wall_ns() * 1e-9, UTC)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A finished recording: the log with its statistics, those of the stream,
    and warnings about the currents.
    """

    path: Path
    log: RunStatistics
    stream: StreamStatistics
    warnings: tuple[str, ...] = ()


def network_of(cell: Cell, block_signals: SignalBlocker = nullcontext) -> CanopenNetwork:
    """Return the amplifiers of a cell, as a context manager.

    Raises:
        ConfigurationInconsistent: the cell file has no bus, or an axis without amplifier.
    """
    guard_ms = GUARD_MS[declared.PacingMode.TIMED]
    if cell.sync is not None:
        # The heartbeat is sent with SYNC: a long period must not stop the axes.
        guard_ms = max(GUARD_MS[cell.sync.pacing], 3 * cell.sync.period_us // 1000)
    return CanopenNetwork(
        cell_address(cell),
        drive_axes(cell),
        guard_ms=guard_ms,
        block_signals=block_signals,
        profiles=shipped_profiles,
    )


@dataclass(frozen=True, slots=True)
class RecordingRequest:
    """A recording to make: its moves, its log, what the robot carries,
    and who permits the motion.
    """

    cell_file: Path  #: file of the cell; the log gets it with all files that it names
    cell: Cell  #: content of this file
    plan: Plan  #: moves to make
    out: Path  #: log to write; must not exist
    payload: Payload | None  #: mounted payload; None without load
    operator: str  #: person or job responsible for the recording
    granted_by: str | None  #: operator who permits the motion; None refuses it
    run_id: str  #: identity of the run in its log
    #: share of the planned speed at which the moves are made, for the log; the plan is slowed down
    #: already (`daq.workflow.plan.slowed`)
    speed: float = 1.0
    #: mass of the payload that was weighed for this recording [kg]; None if it was not
    entered_kg: float | None = None
    #: whether an axis may move that no drive stops when this program is killed
    unguarded: bool = False


def record(
    request: RecordingRequest,
    *,
    clocks: Clocks | None = None,
    free: FreeBytes = free_bytes,
    block_signals: SignalBlocker = nullcontext,
    progress: Callable[[int, int], None] = lambda _move, _moves: None,
    require_released: Callable[[], None] | None = None,
    feed: Feed | None = None,
) -> Recorded:
    """Make a plan's moves and log every sample.

    Args:
        request: the recording to make.
        clocks: those of this computer, if None.
        free: returns the free bytes of a folder's disk.
        block_signals: blocks signals while the axes are stopped.
        progress: receives the number of finished moves and of all moves.
        require_released: check that the robot may move, before the drives are used and again before
            they get power; if it raises, no file is made. By default the interlock of the cell file
            decides, where it declares one.
        feed: gets what the log gets, for consoles.

    The cell's `policy` permits nothing here: it is for jobs, which put its permissions into the
    request.

    Raises:
        UsageError: the weighed mass is not the payload's, or a file of that name exists; no file
            was made.
        MotionRefused: motion is disabled, an axis is unguarded or outside its limits, or the moves
            leave them; no file was made, and nothing has moved, except where an axis was brought
            back (`recovery_move`).
        NotReleased: the interlock does not release the robot; nothing has moved.
        DiskSpaceShort: before the run, nothing has moved; during it, the axes were stopped, and the
            log is complete but marked invalid.
        ConfigurationInconsistent: the cell file is not the one that `request.cell` was read from;
            no file was made, and nothing has moved.
        ConfigurationInconsistent, OutputFailed: see daq/errors.py.
        DriverError: from the bus; the axes were stopped. The samples until then stay in an
            unfinished log (`.part`). No fit reads it; `daq.log.salvage` converts it to a partial
            log.
    """
    clocks = clocks or Clocks()
    cell = request.cell
    granted_by = _permission(request.granted_by)
    check_entered_mass(cell, request.payload, request.entered_kg)
    require_released = require_released or release_check(cell, clocks.now)
    require_released()
    with (
        on_time(),
        network_of(cell, block_signals) as network,
        _sync_producer(cell, network) as declared_producer,
    ):
        network.prepare()
        _require_guarded(network, request.unguarded)
        polling = Polling.found(network, beside_stream=polling_fits(cell))
        drive_scales = network.scales()
        check_nameplates(request.cell_file, cell, drive_scales)
        cell_warnings = _cell_warnings(cell, network, drive_scales, polling)
        readback = readback_of_drives(
            cell.axis_names, network.ampere_per_unit(), network.readback()
        )
        scale = scaling(cell, readback)
        rate_hz = 1e6 / _sync(cell).period_us
        files = _files_of_cell(request)
        # Read the positions first, so that a refusal comes before a file exists. A stream of their
        # own reads them: once the recording's stream runs, it must be read every period, and the
        # checks below last many periods.
        producer, sync_remarks = _start_producer(cell, declared_producer)
        permission = MotionPermission(granted_by, motor_limits(cell, scale))
        pacing_before_run = partial(_pacing, cell, clocks.wall_ns(), clocks, producer)
        start_counts, recovery_remarks = _start_within_limits(
            cell, network, scale, permission, pacing_before_run, require_released
        )
        _pause_sync(producer, network)
        moves, way_remarks = _checked_moves(cell, request.plan, scale, start_counts, permission)
        room = DiskRoom(request.out, free)
        room.require(_log_bytes(cell, moves, start_counts, files))
        temperatures = polling.temperatures(clocks.wall_ns())
        # An interlock may be slow, too: ask it before the first SYNC of the recording's stream.
        require_released()
        run = _run_info(request, rate_hz, clocks)
        content = LogContent.of(cell, run, files, readback)
        with LogWriter(
            request.out,
            content,
            scale.joint_position_of,
            clocks.monotonic_ns,
            waits_for_disk=False,
        ) as log:
            log_and_feed = LogAndFeed(
                log,
                feed or Feed(request.cell_file),
                lambda done: progress(done, len(moves)),
                RecordedMotion(len(cell.axes)),
            )
            run_facts = _facts(cell, scale, run, request.out, len(moves))
            log_and_feed.feed.begin(run_facts, lambda: log.statistics)
            log.readings(temperatures)
            # The samples of this stream are stamped from the start that the log states.
            pacing = _pacing(cell, run.started_wall_ns, clocks, producer)
            stream = SyncStream(network, pacing, log_and_feed.event)
            polling.begin(stream, log.reading)
            for sample in until_complete(stream):
                log_and_feed.sample(sample)
            motion = execute(network, stream, moves, permission)
            check_every = max(1, round(SPACE_CHECK_S * rate_hz))
            disk_full = _log_motion(motion, log_and_feed, room, check_every)
            stream.read_on(LATE_LOSSES_S)
            log.readings(polling.temperatures(stream.time_ns))
            invalid_because = (
                _unfinished_reason(disk_full, log_and_feed.done, len(moves))
                or stream_losses(stream.statistics)
                or log_and_feed.motion.reason(cell, readback, rate_hz)
            )
            log.conclude(
                valid=not invalid_because,
                reason=invalid_because,
                wall_minus_monotonic_ns=clocks.wall_minus_monotonic_ns(),
            )
        log_and_feed.feed.finish()
        if disk_full is not None:
            raise disk_full
        warnings = (
            *cell_warnings,
            *_other_master(network),
            *sync_remarks,
            *recovery_remarks,
            *way_remarks,
            *polling.remarks,
            *_slow_disk(request.out, log.longest_wait_s),
        )
        return Recorded(request.out, log.statistics, stream.statistics, warnings)


def _cell_warnings(
    cell: Cell, network: CanopenNetwork, scales: Sequence[ScaleReading], polling: Polling
) -> tuple[str, ...]:
    """Return what is known before a run that a person should mend, but that stops no recording."""
    warnings = [
        *load_warnings(cell),
        *nameplate_warnings(cell, scales),
        *network.unguarded(),
    ]
    if polling:
        warnings += polling_warnings(cell)
    return tuple(warnings)


def _other_master(network: CanopenNetwork) -> tuple[str, ...]:
    """Return a warning of another program that spoke on the bus as a master; empty without."""
    other = network.other_master()
    if not other:
        return ()
    return (f"{other}; it only read, but end that program before the next run",)


def _slow_disk(out: Path, longest_wait_s: float) -> tuple[str, ...]:
    """Return a warning of a disk on which a part of the log waited long; empty otherwise."""
    if longest_wait_s <= SLOW_DISK_S:
        return ()
    return (
        f"the disk of {out} took {longest_wait_s:.1f} s for a part of the log. No sample is lost, "
        "but a recorder killed at that time would have lost as much: record onto a faster disk",
    )


def _run_info(request: RecordingRequest, rate_hz: float, clocks: Clocks) -> RunInfo:
    """Return what the log says of a run; its start is the present time of the clocks."""
    started_ns = clocks.monotonic_ns()
    wall_ns = started_ns + clocks.wall_minus_monotonic_ns()
    digest = controller_digest(request.cell)
    return RunInfo(
        run_id=request.run_id,
        rate_hz=rate_hz,
        payload=request.payload,
        operator=request.operator,
        software=software(),
        started_wall_ns=wall_ns,
        started_monotonic_ns=started_ns,
        speed=request.speed,
        entered_kg=request.entered_kg,
        controller_sha256=digest,
    )


def _files_of_cell(request: RecordingRequest) -> dict[str, bytes]:
    """Read the files of the cell for the log.

    Raises:
        ConfigurationInconsistent: the cell file was changed since the cell was read from it: the
            log would describe another cell than the one that moves.
    """
    files = bundle(request.cell_file)
    found = bundle_digest(files)
    expected = request.cell.digest
    if found == expected:
        return files
    raise ConfigurationInconsistent(
        str(request.cell_file),
        found=f"another content (digest {found[:12]}) than when this command read it",
        expected=f"the cell that the moves were checked for (digest {expected[:12]})",
        remedy="nothing has moved, and no log was made; start the command again with the new "
        "content, or put the old one back; blocks of a guided session go on with the old one alone",
    )


def controller_digest(cell: Cell) -> str | None:
    """Return the SHA-256 of the controller's file now;
    None if the cell names none or it cannot be read.
    """
    path = cell.controller_path
    try:
        if path is None:
            return None
        return sha256(read_controller_file(path))
    except ControllerUnfit:
        return None


def _facts(cell: Cell, scale: SiScaling, run: RunInfo, out: Path, moves: int) -> RunFacts:
    """Return what a console must know of a run to show its samples in SI."""
    bus_load = {bus.name: load.mean for bus, load in bus_loads(cell)}
    payload = None if run.payload is None else run.payload.name
    return RunFacts(
        run_id=run.run_id,
        log=str(out.resolve()),
        axes=cell.axis_names,
        rate_hz=run.rate_hz,
        moves=moves,
        rad_per_count=scale.rad_per_count.tolist(),
        current_per_unit=scale.current_per_unit.tolist(),
        to_joint=scale.to_joint.tolist(),
        offset_rad=scale.offset_rad.tolist(),
        payload=payload,
        bus_load=bus_load,
    )


@dataclass(slots=True)
class LogAndFeed:
    """Log of a run and the feed of what it gets."""

    log: LogWriter
    feed: Feed
    progress: Callable[[int], None]  #: receives the number of finished moves
    motion: RecordedMotion  #: by which the run is judged at its end
    done: int = 0  #: finished moves

    def sample(self, sample: Sample) -> None:
        """Log and publish one sample."""
        self.log.write(sample)
        self.motion.take(sample)
        self.feed.sample(sample)

    def event(self, event: CellEvent) -> None:
        """Log and publish one event."""
        self.log.event(event)
        self.feed.event(event)
        if event.kind is EventKind.MOVE_END:
            self.done += 1
            self.progress(self.done)


def keep_samples(
    samples: Generator[Sample, None, None], kept: LogAndFeed, room: DiskRoom, check_every: int
) -> None:
    """Log and publish every sample of a motion; end the motion when logging fails.

    Args:
        samples: those of `execute`.
        kept: the log and the feed.
        room: the space on the log's disk.
        check_every: number of samples from one check of that space to the next.

    An error is thrown into `execute`, which stops the axes and attaches to the error what it could
    not confirm. If the generator were only closed, these notes would be lost.

    Raises:
        DiskSpaceShort, OutputFailed, DriverError: the axes were stopped.
    """
    for number, sample in enumerate(samples):
        try:
            kept.sample(sample)
            if number % check_every == 0:
                room.check()
        except BaseException as error:
            samples.throw(error)  # `execute` raises it again, with its notes
            raise


def _log_motion(
    samples: Generator[Sample, None, None],
    log_and_feed: LogAndFeed,
    room: DiskRoom,
    check_every: int,
) -> DiskSpaceShort | None:
    """Log a motion as `keep_samples` does, to its end or until the disk is full.

    Returns:
        The error of a full disk, after which the axes were stopped; None if the motion was
        finished.
    """
    with closing(samples):
        try:
            keep_samples(samples, log_and_feed, room, check_every)
        except DiskSpaceShort as error:
            return error
    return None


def duration_of(moves: Sequence[Move], start_counts: Sequence[int], rate_hz: float) -> float:
    """Return the duration of moves of the motors from given positions, dwells included [s]."""
    total_s = 0.0
    here = tuple(start_counts)
    for move in moves:
        moving_s = max(move.duration_s(here))
        total_s += moving_s + move.dwell_cycles / rate_hz
        here = move.target_counts
    return total_s


def _log_bytes(
    cell: Cell, moves: Sequence[Move], start_counts: Sequence[int], files: Mapping[str, bytes]
) -> int:
    """Return the size of the log of these moves at most [bytes]."""
    rate_hz = 1e6 / _sync(cell).period_us
    longest_s = duration_of(moves, start_counts, rate_hz) + ALLOWANCE_S
    return largest_log_bytes(joint_names(cell), rate_hz, longest_s, files)


def until_complete(stream: SyncStream) -> tuple[Sample, ...]:
    """Return the samples up to the first that has the position of every axis;
    no move can be planned without it.

    Raises:
        SampleLost: more incomplete cycles in a row than the stream tolerates.
        DriverError: from the bus.
    """
    samples = [next(stream)]
    while samples[-1].missing:
        # The stream raises SampleLost after too many incomplete cycles.
        samples.append(next(stream))
    return tuple(samples)


def _positions(network: CanopenNetwork, pacing: Pacing) -> tuple[int, ...]:
    """Return the positions of the axes [counts]; PDOs and objects must agree."""
    stream = SyncStream(network, pacing)
    complete = until_complete(stream)[-1]
    stream.check()
    network.check_feedback(complete)
    return complete.position_counts


def motor_limits(cell: Cell, scale: SiScaling) -> tuple[AxisLimits, ...]:
    """Return the limits of each motor, within which no motor alone can move a joint out of its
    limits [counts].

    A coupled motor turns with several joints: its range is the sum of theirs (eq. 24). The limits
    of the joints are checked in the plan.

    Returns:
        The limits by axis, in the order of the cell.
    """
    limits = limits_of(cell)
    lower_rad = limits.lower - scale.offset_rad
    upper_rad = limits.upper - scale.offset_rad
    # A motor that turns against a joint is lowest where that joint is highest:
    # low = R⁺ q_lower + R⁻ q_upper, with the positive and the negative part of R = R⁺ + R⁻.
    positive_ratio = np.maximum(cell.ratio, 0.0)
    negative_ratio = np.minimum(cell.ratio, 0.0)
    low_rad = positive_ratio @ lower_rad + negative_ratio @ upper_rad
    high_rad = positive_ratio @ upper_rad + negative_ratio @ lower_rad
    low_counts = low_rad / scale.rad_per_count
    high_counts = high_rad / scale.rad_per_count
    # Counts of each motor a radian of each joint: |R| / (rad a count of the motor's row).
    counts_per_joint_rad = np.abs(cell.ratio) * ROUNDING / scale.rad_per_count[:, None]
    velocity_counts_s = counts_per_joint_rad @ limits.velocity
    acceleration_counts_s2 = counts_per_joint_rad @ limits.acceleration
    motors = []
    for motor in range(len(low_counts)):
        motors.append(
            AxisLimits(
                position_min_counts=int(np.floor(low_counts[motor])),
                position_max_counts=int(np.ceil(high_counts[motor])),
                velocity_counts_s=float(velocity_counts_s[motor]),
                acceleration_counts_s2=float(acceleration_counts_s2[motor]),
            )
        )
    return tuple(motors)


def motor_moves(
    cell: Cell, plan: Plan, scale: SiScaling, start_counts: Sequence[int]
) -> tuple[Move, ...]:
    """Convert the joint trapezoids of a plan to motor moves [counts]:
    R is linear, and all axes share the ramps.
    """
    moves = []
    here_rad = scale.joint_position(np.array(start_counts))
    here = tuple(start_counts)
    for planned in plan.moves:
        path = path_of(cell, here_rad, planned)
        target_rad = np.array(planned.target_rad)
        # q_motor = R (q − offset), eq. 24
        motor_rad = cell.ratio @ (target_rad - scale.offset_rad)
        target_counts = np.rint(motor_rad / scale.rad_per_count)
        target = tuple(map(int, target_counts))
        motor_velocity = np.abs(cell.ratio @ path.velocity / scale.rad_per_count)
        motor_acceleration = np.abs(cell.ratio @ path.acceleration / scale.rad_per_count)
        move_limits = _limits_of_move(motor_velocity, motor_acceleration)
        dwell_cycles = round(planned.dwell_s * 1e6 / _sync(cell).period_us)
        moves.append(synchronised_move(here, target, move_limits, dwell_cycles))
        here_rad = target_rad
        here = target
    return tuple(moves)


def _limits_of_move(velocity: FloatArray, acceleration: FloatArray) -> list[AxisLimits]:
    """Return limits within which the fastest trapezoid of the motors is that of the joints.

    `synchronised_move` stays one count below its limits, so that it can round up, and needs some
    velocity of a motor that stands still.

    Args:
        velocity: largest velocity of each motor in this move [counts/s], shape (n,).
        acceleration: its acceleration [counts/s²], shape (n,).
    """
    limits = []
    for motor_velocity, motor_acceleration in zip(velocity, acceleration, strict=True):
        limits.append(
            AxisLimits(
                position_min_counts=0,
                position_max_counts=0,
                velocity_counts_s=max(motor_velocity + 1.0, LEAST_PER_S),
                acceleration_counts_s2=max(motor_acceleration + 1.0, LEAST_PER_S),
            )
        )
    return limits


def _permission(granted_by: str | None) -> str:
    """Return who permits the motion.

    Raises:
        MotionRefused: no one does.
    """
    if granted_by is None:
        raise MotionRefused(
            "a recording without permission to move",
            expected="an operator who permits motion; `policy: {motion: allowed}` is for "
            "`recalibrate` alone",
            remedy="pass --enable-motion",
        )
    return granted_by


def _require_guarded(network: CanopenNetwork, unguarded: bool) -> None:
    """Refuse axes that go on moving when this program is killed, unless that was accepted.

    Raises:
        MotionRefused: names them.
    """
    without = network.without_guard()
    if without and not unguarded:
        remarks = "; ".join(network.unguarded())
        listed = ", ".join(without)
        raise MotionRefused(
            f"axes that are UNGUARDED: {remarks}",
            expected="that every axis watches the recorder's heartbeat (1016h)",
            remedy=f"nothing has moved; pass --unguarded to move {listed} all the "
            "same, with a hand at the emergency stop; a scheduled job needs `policy: {unguarded: "
            "allowed}` in the cell file",
        )


# An abrupt stop, of a brake or a killed recorder, may end a little beyond a limit. No recording
# begins there. A cell file with `policy: {recovery_motion: allowed}` permits a slow return by a
# little; it needs the same permission to move, and the same interlock, as every motion.

LARGEST_SHARE = 0.02
"""Share of an axis's range by which it may be beyond a limit and still be brought back;
farther out, a person has to find out why.
"""
RECOVERY_SPEED = 0.05  #: Share of an axis's limits of velocity and acceleration
INSIDE = 0.001
"""Share of an axis's range by which the return ends within the limit:
a position controller at rest is off by some counts.
"""


def _recovery_limits(start_counts: int, limit: AxisLimits) -> AxisLimits:
    """Return the limits of a motor on its way back, which reach to where it stands."""
    velocity = RECOVERY_SPEED * limit.velocity_counts_s
    acceleration = RECOVERY_SPEED * limit.acceleration_counts_s2
    return AxisLimits(
        position_min_counts=min(limit.position_min_counts, start_counts),
        position_max_counts=max(limit.position_max_counts, start_counts),
        velocity_counts_s=max(velocity, LEAST_PER_S),
        acceleration_counts_s2=max(acceleration, LEAST_PER_S),
    )


def recovery_move(
    cell: Cell, scale: SiScaling, start_counts: Sequence[int], limits: Sequence[AxisLimits]
) -> tuple[Move, tuple[AxisLimits, ...], str] | None:
    """Return the move that brings all axes within their limits, its own limits, and a remark;
    None if all are inside.

    Raises:
        MotionRefused: an axis is outside and the cell does not allow the return, or it is too long
            or not clear.
    """
    outside: list[str] = []
    target: list[int] = []
    largest_share = 0.0
    for name, start, limit in zip(cell.axis_names, start_counts, limits, strict=True):
        low = limit.position_min_counts
        high = limit.position_max_counts
        below = low - start
        above = start - high
        beyond = max(below, above)
        if beyond <= 0:
            target.append(start)
            continue
        share = beyond / max(high - low, 1)
        largest_share = max(largest_share, share)
        percent = 100.0 * share
        outside.append(
            f"{name} at {start} counts, {beyond} ({percent:.2g} % of its range) beyond its limits"
        )
        margin = INSIDE * (high - low)
        nearest_inside = np.clip(start, low + margin, high - margin)
        target.append(round(nearest_inside))
    if not outside:
        return None
    found = "; ".join(outside)
    _require_recovery_allowed(cell, found, largest_share)
    start_rad = scale.joint_position(np.array(start_counts))
    target_rad = scale.joint_position(np.array(target))
    check_return(cell, start_rad, target_rad)
    slow_limits = tuple(map(_recovery_limits, start_counts, limits))
    move = synchronised_move(start_counts, tuple(target), slow_limits)
    return move, slow_limits, f"{found}; it was brought back slowly"


def bring_back(
    network: CanopenNetwork,
    pacing: Pacing,
    move: Move,
    limits: tuple[AxisLimits, ...],
    granted_by: str,
) -> None:
    """Make the recovery move; the network is then as after `prepare`.

    Raises:
        DriverError: as `execute`; the axes were stopped.
    """
    stream = SyncStream(network, pacing)
    permission = MotionPermission(granted_by, limits)
    with closing(execute(network, stream, (move,), permission)) as samples:
        for _ in samples:
            pass
    network.prepare()  # a motion ends the guards


def _require_recovery_allowed(cell: Cell, found: str, share: float) -> None:
    """Refuse a return that the cell does not allow, or that is too long.

    Args:
        cell: the cell with its policy.
        found: the axes beyond their limits, for the message.
        share: how far the farthest of them is beyond, as a share of its range.

    Raises:
        MotionRefused: with what to do instead.
    """
    by_hand = "nothing has moved; bring it back by hand"
    if cell.chain is not None:
        remedy = f"{by_hand}: no motor of a closed chain moves alone"
    elif share > LARGEST_SHARE:
        remedy = f"{by_hand}, and find out how it got there: it is too far for `recovery_motion`"
    elif cell.recovery_motion is not Permission.ALLOWED:
        remedy = (
            f"{by_hand}, or allow a slow return with `policy: {{recovery_motion: allowed}}` "
            "in the cell file"
        )
    else:
        return
    raise MotionRefused(found, expected="every axis within its limits", remedy=remedy)


def _start_within_limits(
    cell: Cell,
    network: CanopenNetwork,
    scale: SiScaling,
    permission: MotionPermission,
    make_pacing: Callable[[], Pacing],
    require_released: Callable[[], None],
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the positions of the axes [counts], brought back within their limits if need be,
    and remarks about that.

    Raises:
        MotionRefused: an axis is outside its limits, and may not be brought back.
        DriverError: as `execute`.
    """
    start_counts = _positions(network, make_pacing())
    recovery = recovery_move(cell, scale, start_counts, permission.limits)
    if recovery is None:
        return start_counts, ()
    require_released()
    move, slow_limits, remark = recovery
    bring_back(network, make_pacing(), move, slow_limits, permission.granted_by)
    recovered_counts = _positions(network, make_pacing())
    return recovered_counts, (remark,)


def _checked_moves(
    cell: Cell,
    plan: Plan,
    scale: SiScaling,
    start_counts: Sequence[int],
    permission: MotionPermission,
) -> tuple[tuple[Move, ...], tuple[str, ...]]:
    """Convert a plan to motor moves that keep the limits, with a clear way to its first target,
    and remarks about it.

    Raises:
        MotionRefused: they do not keep the limits, or no way to the first target is clear.
    """
    start_rad = scale.joint_position(np.array(start_counts))
    moves_to_first, remark = way_to_first_target(cell, plan, start_rad)
    # They replace the plan's first move: its target is the last of theirs.
    plan_from_start = replace(plan, moves=(*moves_to_first, *plan.moves[1:]))
    moves = motor_moves(cell, plan_from_start, scale, start_counts)
    check_moves(start_counts, moves, permission, cell.axis_names)
    remarks = (remark,) if remark else ()
    return moves, remarks


def _unfinished_reason(disk_full: DiskSpaceShort | None, done: int, moves: int) -> str:
    """Return why the moves were not finished; empty where they were."""
    if disk_full is None:
        return ""
    return f"stopped after {done} of {moves} moves: {disk_full.found}"


def stream_losses(statistics: StreamStatistics) -> str:
    """Return the losses of a run, each of which makes it invalid;
    empty without a lost or unexplained frame.
    """
    return loss_reason(
        {
            Loss.MISSING: statistics.missing,
            Loss.LATE: statistics.late,
            Loss.WRONG_LENGTH: statistics.wrong_length,
            Loss.DUPLICATE: statistics.duplicate,
            Loss.SURPLUS: statistics.surplus,
            Loss.SKIPPED_PERIODS: statistics.skipped_periods,
            Loss.KERNEL: statistics.kernel_dropped,
            Loss.INTERFACE: statistics.interface_dropped,
            Loss.BACKLOG: statistics.backlog_dropped,
        }
    )


def _sync(cell: Cell) -> declared.Sync:
    """Return the SYNC of a cell with a bus: its cell file declares one."""
    assert cell.sync is not None
    return cell.sync


def _sync_producer(
    cell: Cell, network: CanopenNetwork
) -> AbstractContextManager[SyncProducer | None]:
    """Return the SYNC producer; None if this program sends SYNC.

    On one SocketCAN bus the kernel sends it for this program, which a busy computer delays.
    """
    sync = _sync(cell)
    address = network.link.address
    if sync.producer == declared.KERNEL:
        return KernelProducer(network, sync.period_us)
    if sync.producer == declared.RECORDER:
        is_timed = sync.pacing is declared.PacingMode.TIMED
        kernel_can = isinstance(address, BusAddress) and address.kind.has_kernel_sync
        if is_timed and kernel_can:
            return KernelProducer(network, sync.period_us)
        return nullcontext()
    return DriveProducer(network, cell.axis_names.index(sync.producer), sync.period_us)


def _start_producer(
    cell: Cell, producer: SyncProducer | None
) -> tuple[SyncProducer | None, tuple[str, ...]]:
    """Start the SYNC producer, if there is one.

    Returns:
        The producer, None if this program sends SYNC; and a remark if it does so because the
        kernel cannot.

    Raises:
        BusError: the producer that the cell file names cannot send SYNC.
    """
    try:
        if producer is not None:
            producer.start()
    except BusError as error:
        if _sync(cell).producer != declared.RECORDER:
            raise
        remark = f"SYNC is sent by this program, and late when the computer is busy: {error.reason}"
        return None, (remark,)
    return producer, ()


def _pause_sync(producer: SyncProducer | None, network: CanopenNetwork) -> None:
    """Stop a SYNC that the recording's stream starts anew, and wait for the last answers.

    The kernel's SYNC then comes at any time after its last one. Answers to that one must not come
    then: they would be taken for answers to the stream's first.
    """
    if producer is not None:
        producer.rest()
        network.link.wait(LATEST_ANSWERS_S)


def _pacing(cell: Cell, start_ns: int, clocks: Clocks, producer: SyncProducer | None) -> Pacing:
    """Return the pacing of one stream, with the producer started.

    Args:
        cell: the cell, with its SYNC.
        start_ns: time stamp of the stream's first period.
        clocks: the clocks of the recording.
        producer: the producer of SYNC; None if this program sends it.
    """
    sync = _sync(cell)
    period_ns = sync.period_us * 1000
    clock = clocks.monotonic_ns
    if producer is not None:
        # It may have ended since its first start, while no stream was read.
        producer.start()
        silence_s = max(SYNC_SILENCE_S, SYNC_SILENCE_PERIODS * period_ns * 1e-9)
        return producer.pacing(silence_s, start_ns, clock)
    if sync.pacing is declared.PacingMode.LOCKSTEP:
        return LockstepSync(period_ns, timeout_s=LOCKSTEP_TIMEOUT_S, start_ns=start_ns, clock=clock)
    return TimedSync(period_ns, start_ns=start_ns, clock=clock)
