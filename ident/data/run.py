"""One recording in SI units, as the identification receives it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    BoolArray,
    FloatArray,
    IntArray,
    require_entries,
    require_flag,
    require_kind,
    require_number,
)
from ident.data.channel_faults import JudgedChannels
from ident.data.conditioning import Conditioning
from ident.data.torque_channel import TorqueChannel
from ident.errors import DataUnfit
from ident.model.bodies import Payload


@dataclass(frozen=True, slots=True)
class Recording:
    """How a log was made: evidence for the gates before a controller; axes in their order."""

    #: Unix time of its first sample [s]; None where an imported log does not contain it
    recorded_s: float | None
    #: Mass of the payload as it was entered at the recording, from the scale; None without an
    #: entry.
    entered_kg: float | None
    #: serial number of each amplifier, None for one that reports none
    serials: tuple[int | None, ...]
    saturated_percent: tuple[float, ...]  #: share of each axis's samples in which a limit acted [%]
    lost_cycles: int  #: SYNC cycles that are not in it
    missing: tuple[int, ...]  #: samples in which each axis did not answer
    #: Digest of the controller's file when it was recorded; None where the cell named none.
    controller_sha256: str | None
    #: person or job responsible for it; None in calibrations of earlier versions
    operator: str | None = None
    #: Digest of the description in the log, where a corrected description of the cell replaced it;
    #: None where none did, and empty where the one in the log could not be read.
    replaced_configuration_sha256: str | None = None
    #: sections in which the corrected description differs from the one in the log
    corrected: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Run:
    """One recording of n joints over k samples at a constant rate;
    lists and data frames will do for arrays.
    """

    #: for messages and reports (the log's stem); another one for each run that is of no log
    name: str
    time_s: FloatArray  #: time of each sample [s], shape (k,), uniform
    position_rad: FloatArray  #: joint positions [rad; m for a prismatic joint], shape (k, n)
    #: Input references of the current loops, one a motor [A, or whatever unit the drive speaks: a
    #: gain is Nm at the joint per that unit], shape (k, n).
    current_a: FloatArray
    payload: Payload | None = None  #: what was mounted, or None without load
    #: Number of the move that each sample belongs to, shape (k,), or None where it was not
    #: recorded.
    move: IntArray | None = None
    digest: str = ""  #: of the log it was read from (sha256, hex)
    #: Whether each sample may be used, shape (k, n): False where a frame was missing or a limit
    #: acted. A flag is of the position of axis i and of the current of motor i.
    valid: BoolArray | None = None
    #: When the run began, on a clock that the runs of one session share [s]; None without a clock.
    started_s: float | None = None
    #: It is what was saved of a recording that was never finished, or one whose losses were
    #: accepted.
    partial: bool = False
    recording: Recording | None = None  #: how the log was made; None where the run is from no log
    #: Temperature of each motor or its drive [°C], shape (k, n), NaN for one without; None where
    #: none was recorded.
    temperature_c: FloatArray | None = None
    #: The controller's own torque, one an axis, for a comparison with the gains that no fit uses;
    #: empty without any.
    torque_channels: tuple[TorqueChannel, ...] = ()
    #: What was found wrong with positions and currents when the log was read; None of a run that
    #: was made from arrays. It is valid for these very arrays.
    judged_channels: JudgedChannels | None = field(default=None, repr=False, compare=False)

    # Whatever becomes an array: the fields are converted where they are first used
    if TYPE_CHECKING:

        def __init__(
            self,
            name: str,
            time_s: ArrayLike,
            position_rad: ArrayLike,
            current_a: ArrayLike,
            payload: Payload | None = None,
            move: ArrayLike | None = None,
            digest: str = "",
            valid: ArrayLike | None = None,
            started_s: float | None = None,
            partial: bool = False,
            recording: Recording | None = None,
            temperature_c: ArrayLike | None = None,
            torque_channels: tuple[TorqueChannel, ...] = (),
            judged_channels: JudgedChannels | None = None,
        ) -> None: ...

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        return float((len(self.time_s) - 1) / (self.time_s[-1] - self.time_s[0]))


def require_entry(run: Run) -> None:
    """Refuse an entry of a list of runs that is no run.

    Raises:
        ModelError: for the entry.
    """
    remedy = "write Run(name, time_s, position_rad, current_a)"
    require_kind("an entry of the runs", run, Run, remedy)


def require_named(run: Run) -> None:
    """Refuse a run with a field of another type that is no array, before a message or a report
    uses it.

    Raises:
        ModelError: for the field.
    """
    require_kind("name of a run", run.name, str, "write Run('bare', time_s, ...)")
    of_run = f"of {run.name!r}"
    if run.payload is not None:
        remedy = "write Payload(name, mounting, known)"
        require_kind(f"payload {of_run}", run.payload, Payload, remedy)
    require_kind(f"digest {of_run}", run.digest, str, "leave it out of a run that is of no log")
    require_flag(f"partial {of_run}", run.partial)
    if run.recording is not None:
        remedy = "leave it out of a run that is of no log"
        require_kind(f"recording {of_run}", run.recording, Recording, remedy)
    remedy = "give a list of them, or leave it out"
    require_entries(f"torque_channels {of_run}", run.torque_channels, TorqueChannel, remedy)
    if run.judged_channels is not None:
        remedy = "leave it out of a run that is of no log"
        require_kind(f"judged_channels {of_run}", run.judged_channels, JudgedChannels, remedy)
    if run.started_s is not None:
        remedy = "leave it out without a clock that the runs share"
        require_number(f"started_s of {run.name!r}", run.started_s, remedy=remedy)


class SeenRuns:
    """Runs of a fit so far.

    No two may have the same samples. Two may have one name if they are of different logs.
    """

    def __init__(self) -> None:
        self._names: set[tuple[str, str]] = set()
        #: name and load of each run by the digest of its samples: the runs are not kept
        self._by_content: dict[bytes, str] = {}

    def add(self, run: Run) -> None:
        """Add a run.

        Raises:
            DataUnfit: there is one of this name, or with the same samples.
        """
        if (run.name, run.digest) in self._names:
            raise DataUnfit(
                run.name, "found two runs of this name; expected another name for each; rename one"
            )
        self._names.add((run.name, run.digest))
        content = content_digest(run)
        if content is None:
            return
        if content in self._by_content:
            raise DataUnfit(
                run.name,
                f"found the same samples, {_load_text(run)}, as in run "
                f"{self._by_content[content]}; expected each recording once, in the fit or held "
                "out, with the payload that was mounted; leave one of the two out",
            )
        self._by_content[content] = f"{run.name!r}, {_load_text(run)}"


def _load_text(run: Run) -> str:
    """Say what was mounted during a run."""
    if run.payload is None:
        return "without load"
    return f"with payload {run.payload.name!r}"


def content_digest(run: Run) -> bytes | None:
    """Digest of the samples of a run that count; None where they are no arrays of numbers.

    One recording may be split into the fit and what is held out, by the samples that are valid.
    """
    digest = blake2b()
    parts: list[FloatArray | BoolArray] = [run.position_rad, run.current_a]
    if run.valid is not None:
        parts.append(run.valid)
    for values in parts:
        try:
            array = np.asarray(values)
        except (TypeError, ValueError, OverflowError):
            return None
        if array.dtype.kind not in "fiub":
            return None
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def usual_conditioning(runs: Iterable[Run]) -> Conditioning:
    """Return the filters for some runs where the caller gives none: see `Conditioning.for_rates`.

    A run whose times are none does not count: `ident.data.dataset.differentiate` refuses it.
    """
    rates_hz: list[float] = []
    for run in runs:
        try:
            time_s = np.asarray(run.time_s, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            continue
        if time_s.ndim != 1 or len(time_s) < 2:
            continue
        duration_s = float(time_s[-1] - time_s[0])
        if SMALLEST_NUMBER < duration_s < LARGEST_NUMBER:
            rates_hz.append((len(time_s) - 1) / duration_s)
    return Conditioning.for_rates(rates_hz)
