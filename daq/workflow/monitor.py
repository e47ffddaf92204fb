"""The work of `drivegain monitor`: it reads the bus, publishes every sample for consoles,
and predicts the currents.

While a recorder of drivegain leads the bus, the recorder's feed names the run: its rate, payload
and the scale of its currents. With another master the rate is counted, and the scale is known
only if the drives were queried before.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import isfinite, nan
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, PacingMode
from daq.config.cell_buses import bus_loads_percent
from daq.errors import LogIncomplete
from daq.log.conversion import SiScaling, scaling
from daq.log.feed import Feed, RunFacts, facts_of_recorder
from daq.log.metadata import AxisReadback, Readback, RunStatistics
from daq.workflow.bus_lock import bus_taken
from daq.workflow.events import ALARMING, explain_error_code
from daq.workflow.live_prediction import Predictor, Recent, RecentCurrent, predictor_of
from drivers.canopen.emcy import ErrorCode, explain, read_error_code
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.scale import read_scale
from drivers.errors import DriverError
from drivers.messages import CellEvent, EventKind, Sample
from drivers.stream.monitor import READING_S, CellMonitor, CellReading, ReadingSource
from ident.calibration import Calibration
from ident.errors import IdentificationError

FACTS_S = 0.1  #: Time for a recorder to name its run; it sends to a new console within 20 ms
KEPT_EVENTS = 5  #: Alarming events, and others
SAME_RATE = 0.01  #: Largest relative difference at which two rates of SYNC are the same
CHANGED_RATE = 0.1  #: Relative difference at which it is another one, besides lost SYNCs


@dataclass(frozen=True, slots=True)
class _SampleSource:
    """Origin and scale of the samples; when they change, curves and prediction begin anew."""

    reading: ReadingSource
    recorded: bool  #: the facts are those of a recorder
    #: of the samples, counted here; None if recorded: it is then in the recorder's facts
    rate_hz: float | None
    ampere: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class CellPrediction:
    """Currents that a calibration predicts, and their premise."""

    payload: str | None  #: name of the mounted one; None without one
    remark: str  #: why there are no currents; empty if there are
    axes: Sequence[RecentCurrent]  #: of each axis; empty where there are none


@dataclass(frozen=True, slots=True)
class WatchedCell:
    """One reading of the bus with all that is shown with it."""

    reading: CellReading
    #: of each joint [rad or m], None where a motor that moves it is unknown
    position: Sequence[float | None]
    #: amperes per raw unit of each axis' current, None where unknown
    ampere: Sequence[float | None]
    events: Sequence[CellEvent]  #: recent ones, oldest first
    #: error code of axes in fault, by name
    faults: Mapping[str, ErrorCode] = field(default_factory=dict)
    recorder: bool = False  #: whether a recording or job of drivegain on this computer has the bus
    prediction: CellPrediction | None = None  #: None without a calibration


class CellWatch:
    """Reads the bus, publishes every sample, and predicts the currents."""

    def __init__(
        self,
        cell_file: Path,
        cell: Cell,
        network: CanopenNetwork,
        feed: Feed,
        calibration: Calibration | None,
        payload: str | None,
    ) -> None:
        self._cell_file = cell_file
        self._cell = cell
        self._network = network
        self._feed = feed
        self._calibration = calibration
        self._payload = payload
        offset_ns = time.time_ns() - network.link.clock()
        self._monitor = CellMonitor(
            network.link, network.axes, self._take, offset_ns, taken=lambda: bus_taken(cell)
        )
        self._ampere: list[float | None] = [None] * len(network.axes)
        self._events: deque[CellEvent] = deque(maxlen=KEPT_EVENTS)
        # Kept apart, so that other events do not displace them.
        self._alarms: deque[CellEvent] = deque(maxlen=KEPT_EVENTS)
        self._unscaled = set(range(len(network.axes)))  # axes whose scale was not asked for yet
        self._lockstep = cell.sync is not None and cell.sync.pacing is PacingMode.LOCKSTEP
        self._codes: dict[int, int] = {}  # last error code of each axis that is in fault
        self._facts: RunFacts | None = None
        self._source: _SampleSource | None = None
        self._samples: list[Sample] = []  # since the last reading
        self._count = 0
        self._missing = [0] * len(network.axes)
        self._cycles = range(0)  # of the run so far
        self._predictor: Predictor | None = None
        self._recent: Recent | None = None
        self._remark = ""
        self._sync_hz = 0.0  # of the last reading

    def listen(self, seconds: float) -> None:
        """Listen for another master; its samples count for the first reading."""
        reading = self._monitor.watch(seconds)
        # At the start a node's presence is no news; an error is.
        events = tuple(event for event in reading.events if event.kind is not EventKind.NMT)
        self._take_events(events, reading)
        self._follow(reading, bus_taken(self._cell))

    def read(self, interval_s: float) -> WatchedCell:
        """Read the bus for a time."""
        reading = self._monitor.watch(interval_s)
        self._take_events(reading.events, reading)
        self._query(reading)
        recorder = bus_taken(self._cell)
        self._follow(reading, recorder)
        loads = zip(self._cell.buses, bus_loads_percent(self._cell, reading), strict=True)
        self._feed.measured({bus.name: load / 100.0 for bus, load in loads})
        self._predict()
        alarms_and_events = sorted((*self._alarms, *self._events), key=lambda event: event.time_ns)
        return WatchedCell(
            reading,
            joint_positions(self._cell, reading),
            tuple(self._ampere),
            alarms_and_events,
            faults=self._faults(),
            recorder=recorder,
            prediction=self._prediction(),
        )

    def _take(self, sample: Sample) -> None:
        self._samples.append(sample)
        first = self._cycles.start if self._count else sample.cycle
        self._cycles = range(first, sample.cycle + 1)
        self._count += 1
        for axis in range(len(self._missing)):
            self._missing[axis] += sample.missing >> axis & 1
        if self._facts is not None:
            self._feed.sample(sample)

    def _take_events(self, events: tuple[CellEvent, ...], reading: CellReading) -> None:
        for event in events:
            if event.kind is EventKind.BUS_BUSY:
                continue  # another master is no event here: the head line names it
            (self._alarms if event.kind in ALARMING else self._events).append(event)
            if event.axis is not None and event.kind in (EventKind.EMCY, EventKind.EMCY_RESET):
                if event.kind is EventKind.EMCY:
                    self._codes[event.axis] = event.code
                else:
                    self._codes[event.axis] = 0
            if self._facts is not None:
                self._feed.event(event)
        for number, axis in enumerate(reading.axes):
            if not axis.in_fault:
                self._codes.pop(number, None)

    def _query(self, reading: CellReading) -> None:
        """On a quiet bus, read the current's scale of each axis once,
        and the error code of an axis in fault.
        """
        asked = reading.source is ReadingSource.ASKED
        for number, (axis, found) in enumerate(zip(self._network.axes, reading.axes, strict=True)):
            if not asked or found.delay_s is None or found.is_late:
                continue
            if bus_taken(self._cell):
                # A recorder has come meanwhile, and would refuse a bus on which it hears requests
                return
            if number in self._unscaled:
                self._unscaled.remove(number)
                self._monitor.pause()
                with suppress(DriverError):  # its current stays a raw number, and is shown as one
                    access = self._network.link.objects(axis.node_id)
                    self._ampere[number] = read_scale(access, axis.profile).ampere_per_unit
            if found.in_fault and number not in self._codes:
                self._monitor.pause()
                self._codes[number] = read_error_code(self._network.link.objects(axis.node_id))
                self._publish_fault(number)

    def _publish_fault(self, axis: int) -> None:
        """Show an error to the console that it cannot know:
        of before the run, or read from the drive.
        """
        code = self._codes[axis]
        if code and self._facts is not None:
            text = f"in fault: {explain(code).hex} {explain(code).text}"
            self._feed.event(CellEvent(time.time_ns(), axis, EventKind.EMCY, code, text))

    def _faults(self) -> dict[str, ErrorCode]:
        faults = {}
        for axis, code in self._codes.items():
            if code:
                name = self._cell.axis_names[axis]
                faults[name] = explain_error_code(code)
        return faults

    def _follow(self, reading: CellReading, recorder: bool) -> None:
        """Begin anew where the source of the samples has changed."""
        if reading.source is ReadingSource.OVERHEARD and reading.sync_hz == 0.0:
            self._facts = None
            self._source = None
            self._remark = "no prediction: there is no SYNC"
            self._samples.clear()
            return
        recorder = recorder and reading.source is ReadingSource.OVERHEARD
        recorded = self._source is not None and self._source.recorded and recorder
        if recorder and not recorded:
            run = facts_of_recorder(self._cell_file, FACTS_S)
        else:
            run = None
        if run is not None:
            self._ampere = [value if isfinite(value) else None for value in run.current_per_unit]
        recorded = recorded or run is not None
        rate_hz = None if recorded else self._rate_hz(reading)
        source = _SampleSource(reading.source, recorded, rate_hz, tuple(self._ampere))
        if source == self._source or (rate_hz is None and not recorded):
            return
        if self._source is not None:
            self._samples.clear()  # they are of another rate
        self._source = source
        try:
            if run is None:
                facts = self._own_facts(rate_hz or 0.0)
            else:
                facts = replace(run, log=None, moves=0, bus_load={})
            self._begin(facts)
        except LogIncomplete as error:
            self._facts = None
            self._remark = str(error)

    def _rate_hz(self, reading: CellReading) -> float | None:
        """Rate of the samples; None where SYNC began or changed within a reading,
        whose count is then not its rate.
        """
        if reading.source is ReadingSource.ASKED:
            return 1.0 / READING_S
        sync = self._cell.sync
        declared_hz = 0.0 if sync is None else 1e6 / sync.period_us
        if self._lockstep:
            return declared_hz
        before_hz = self._sync_hz
        self._sync_hz = reading.sync_hz
        counting_hz = 2.0 / reading.seconds  # error of a count of SYNCs
        known_hz = None
        if self._source is not None and self._source.reading is reading.source:
            known_hz = self._source.rate_hz
        if known_hz is not None:
            change_hz = abs(reading.sync_hz - known_hz)
            if change_hz < CHANGED_RATE * known_hz + counting_hz:
                return known_hz
        change_hz = abs(reading.sync_hz - before_hz)
        if before_hz == 0.0 or change_hz > SAME_RATE * before_hz + counting_hz:
            return None
        difference_hz = abs(reading.sync_hz - declared_hz)
        if difference_hz < SAME_RATE * declared_hz + counting_hz:
            return declared_hz
        return reading.sync_hz

    def _own_facts(self, rate_hz: float) -> RunFacts:
        """Facts of a run that no recorder names."""
        units = (nan if ampere is None else ampere for ampere in self._ampere)
        answers = zip(self._cell.axis_names, units, strict=True)
        axes = tuple(AxisReadback(name, unit) for name, unit in answers)
        scale = scaling(self._cell, Readback(axes))
        return RunFacts(
            run_id="monitor",
            log=None,
            axes=self._cell.axis_names,
            rate_hz=rate_hz,
            moves=0,
            rad_per_count=scale.rad_per_count.tolist(),
            current_per_unit=scale.current_per_unit.tolist(),
            to_joint=scale.to_joint.tolist(),
            offset_rad=scale.offset_rad.tolist(),
            payload=self._payload,
            bus_load={},
        )

    def _begin(self, facts: RunFacts) -> None:
        """Publish a run and begin its prediction."""
        if self._lockstep:
            self._monitor.period_ns = None
        else:
            self._monitor.period_ns = round(1e9 / facts.rate_hz)
        self._facts = facts
        self._count = 0
        self._missing = [0] * len(facts.axes)
        self._feed.begin(facts, self._statistics)
        for axis in self._codes:
            self._publish_fault(axis)
        self._predictor = self._recent = None
        if self._calibration is not None:
            self._predictor, self._remark = predictor_of(self._calibration, self._cell, facts)
            if self._predictor is None:
                self._recent = None
            else:
                self._recent = Recent(self._predictor.rows_hz)

    def _statistics(self) -> RunStatistics:
        lost = len(self._cycles) - self._count
        return RunStatistics(self._count, lost, tuple(self._missing), valid=True)

    def _predict(self) -> None:
        """Take the samples of a reading."""
        whole = [sample for sample in self._samples if sample.missing == 0]
        self._samples.clear()
        if self._predictor is None or self._recent is None or self._facts is None or not whole:
            return
        scale = self._facts.scaling
        counts = np.array([sample.position_counts for sample in whole], dtype=np.int64)
        position = scale.joint_position(counts)
        current = np.array([sample.current_raw for sample in whole]) * scale.current_per_unit
        try:
            cycles = np.array([sample.cycle for sample in whole])
            for rows in self._predictor.take(cycles, position, current):
                self._recent.add(rows)
        except IdentificationError as error:
            self._predictor = None
            self._remark = f"no prediction: {error}"

    def _prediction(self) -> CellPrediction | None:
        if self._calibration is None:
            return None
        if self._facts is None:
            return CellPrediction(payload=self._payload, remark=self._remark, axes=())
        axes = () if self._recent is None else self._recent.axes()
        return CellPrediction(payload=self._facts.payload, remark=self._remark, axes=axes)


def joint_positions(cell: Cell, reading: CellReading) -> list[float | None]:
    """Position of each joint [rad or m], None where a motor that moves it is unknown."""
    counts_per_turn = np.array([axis.counts_per_revolution or np.inf for axis in cell.axes])
    rad_per_count = 2.0 * np.pi / counts_per_turn
    is_unknown = [axis.position_counts is None for axis in reading.axes]
    unknown = np.array(is_unknown) | (rad_per_count == 0.0)
    to_joint = np.linalg.inv(cell.ratio).astype(np.float64)
    offset = np.array([axis.zero_offset_rad for axis in cell.axes])
    scale = SiScaling(rad_per_count, to_joint, offset, current_per_unit=np.full(len(offset), nan))
    counts = [axis.position_counts or 0 for axis in reading.axes]
    joint = scale.joint_position(np.array(counts))
    known = scale.joints_known(~unknown)
    positions: list[float | None] = []
    for is_known, position in zip(known, joint, strict=True):
        positions.append(float(position) if is_known else None)
    return positions
