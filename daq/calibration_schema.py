"""Schema of calibration.yaml: its keys and types, for the file border only."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from daq.configuration.yaml_file import StrictModel
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter, Source
from ident.recording import Recording
from ident.relative_error import RelativeError

_Deviation = Annotated[float, Field(ge=0.0)]


class GainEntry(StrictModel):
    """One drive gain; the percentages are for readers."""

    axis: str
    value: float
    std: _Deviation
    std_percent: float | None
    unit: str
    nameplate: float
    change_percent: float | None


class ParameterEntry(StrictModel):
    """One dynamic parameter or coefficient of an effect."""

    name: str
    value: float
    std: _Deviation
    std_percent: float | None
    unit: str


class RelativeErrorEntry(StrictModel):
    """Relative errors in percent; null for an axis that did not move."""

    axes: tuple[float | None, ...]
    total: float


class EffectEntry(StrictModel):
    """One accepted effect."""

    name: str
    axis: str
    settings: dict[str, float]
    coefficients: tuple[ParameterEntry, ...]
    error_before_percent: float
    error_after_percent: float
    ambiguity: tuple[str, ...]


class RecordingEntry(StrictModel):
    """How a log came to be."""

    recorded_s: float | None
    entered_kg: float | None
    serials: tuple[int | None, ...]
    saturated_percent: tuple[float, ...]
    lost_cycles: int
    missing: tuple[int, ...]
    controller_sha256: str | None


class SourceEntry(StrictModel):
    """One log; files of earlier versions say nothing of payload and recording, and none of them could be partial."""

    name: str
    sha256: str
    role: str
    partial: bool = False
    payload: str | None = None
    mass_kg: float | None = None
    recording: RecordingEntry | None = None


class CalibrationDocument(StrictModel):
    """The whole file; `digests` are compared by the reader."""

    format: Literal["drivegain-calibration"]
    version: int
    digests: dict[str, str]
    cell: str
    method: str
    gains: tuple[GainEntry, ...]
    parameters: tuple[ParameterEntry, ...]
    relative_error_percent: RelativeErrorEntry
    holdout_error_percent: RelativeErrorEntry | None
    condition: float
    rows: int
    filter: dict[str, int | float | list[float]]
    effects: tuple[EffectEntry, ...]
    sources: tuple[SourceEntry, ...]
    configuration_sha256: str
    created: str
    software: str
    session_began_s: float | None = None
    nameplate_holdout_error_percent: RelativeErrorEntry | None = None
    recording_configuration_sha256: str | None = None
    """Files of earlier versions do not have these three."""


def _parameter(entry: ParameterEntry) -> Parameter:
    return Parameter(entry.name, entry.value, entry.std, entry.unit)


def _error(entry: RelativeErrorEntry) -> RelativeError:
    return RelativeError(tuple(math.nan if value is None else value for value in entry.axes), entry.total)


def _perhaps(entry: RelativeErrorEntry | None) -> RelativeError | None:
    return None if entry is None else _error(entry)


def _source(entry: SourceEntry) -> Source:
    told = entry.recording
    recording = None if told is None else Recording(**told.model_dump())
    return Source(entry.name, entry.sha256, entry.role, entry.partial, entry.payload, entry.mass_kg, recording)


def calibration_of(entries: CalibrationDocument) -> Calibration:
    """The calibration that a checked document says."""
    return Calibration(
        cell=entries.cell,
        method=entries.method,
        gains=tuple(Gain(g.axis, g.value, g.std, g.unit, g.nameplate) for g in entries.gains),
        parameters=tuple(_parameter(p) for p in entries.parameters),
        effects=tuple(
            AcceptedEffect(
                name=e.name,
                axis=e.axis,
                settings=dict(e.settings),
                coefficients=tuple(_parameter(c) for c in e.coefficients),
                error_before_percent=e.error_before_percent,
                error_after_percent=e.error_after_percent,
                ambiguity=e.ambiguity,
            )
            for e in entries.effects
        ),
        relative_error_percent=_error(entries.relative_error_percent),
        holdout_error_percent=_perhaps(entries.holdout_error_percent),
        condition=entries.condition,
        rows=entries.rows,
        filter=dict(entries.filter),
        sources=tuple(_source(s) for s in entries.sources),
        configuration_sha256=entries.configuration_sha256,
        created=entries.created,
        software=entries.software,
        session_began_s=entries.session_began_s,
        nameplate_holdout_error_percent=_perhaps(entries.nameplate_holdout_error_percent),
        recording_configuration_sha256=entries.recording_configuration_sha256,
    )
