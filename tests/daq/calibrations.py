"""Calibrations for tests: one that every gate lets through,
and hypothesis strategies for any other.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from daq.config.cell_file import load_cell
from daq.documents.calibration_file import save_calibration
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter, Source
from ident.data.run import Recording
from ident.estimators.estimate import RelativeError

NAMEPLATE = (32.96, 32.96, 25.65, -11.52, 18.48, 7.68)
IDENTIFIED = (33.9, 32.4, 24.2, -9.21, 16.3, 6.79)
AXES = ("J1", "J2", "J3", "J4", "J5", "J6")
RECORDED = datetime(2025, 1, 2, 2, 0, 0, tzinfo=UTC)
KEYS = {axis: f"drives.{axis}.gain" for axis in AXES}


def demo_calibration() -> Calibration:
    """Calibration of the demo cell, with the gains of the paper's Table 4 and σ of 0.4 %."""
    sha256 = "a" * 64
    source = Source("unloaded", sha256, "fit", recording=demo_recording())
    sources = (
        source,
        Source("loaded", "b" * 64, "fit", False, "disc", 4.59, demo_recording(4.592)),
        Source("held-out", "d" * 64, "holdout", False, "disc", 4.59, demo_recording(4.588)),
    )
    gains = tuple(
        Gain(axis, value, 0.004 * abs(value), "Nm/A", nameplate)
        for axis, value, nameplate in zip(AXES, IDENTIFIED, NAMEPLATE, strict=True)
    )
    coefficients = (Parameter("c", 0.12, 0.002, "1"),)
    accepted_effect = AcceptedEffect(
        "load-friction", "J3", {"power": 1.0}, coefficients, 6.1, 3.4, ()
    )
    effects = (accepted_effect,)
    parameter = Parameter("ZZ1R", 1.25, 0.01, "kg m²")
    parameters = (parameter, Parameter("off3", 0.0, 0.02, "Nm"))
    axes = (3.1, 2.8, 3.4, 4.0, 5.5, 4.9)
    relative_error_percent = RelativeError(axes, 3.2)
    holdout_error_percent = RelativeError((3.2, 2.9, 3.5, 4.1, 5.6, 5.0), 3.3)
    current_residual = (0.03, 0.05, 0.02, 0.02, 0.01, 0.01)
    relative_error = RelativeError((4.2, 3.9, 4.5, 5.1, 6.6, 6.0), 4.3)
    return Calibration(
        cell="demo",
        method="ml",
        gains=gains,
        parameters=parameters,
        effects=effects,
        relative_error_percent=relative_error_percent,
        holdout_error_percent=holdout_error_percent,
        condition=812.0,
        rows=14400,
        filter={"position_cutoff_hz": 40.0, "standstill_rad_s": [0.03] * 6},
        sources=sources,
        configuration_sha256="c" * 64,
        created="2025-01-02T03:04:05+00:00",
        software="drivegain 0.1.0",
        nameplate_holdout_error_percent=relative_error,
        recording_configuration_sha256=None,
        current_residual=current_residual,
    )


def calibration_for(cell_file: Path, factor: float = 1.0, **changes: Any) -> Path:
    """A calibration that every gate of the demo cell lets through, its gains times a factor;
    its file.
    """
    declared = load_cell(cell_file)
    now = datetime.now(UTC)
    calibration = recorded(demo_calibration(), now - timedelta(hours=1))
    gains = tuple(replace(gain, value=gain.value * factor) for gain in calibration.gains)
    calibration = replace(
        calibration,
        created=now.isoformat(),
        configuration_sha256=declared.digest,
        recording_configuration_sha256=declared.recording_digest,
        gains=gains,
    )
    path = cell_file.parent / f"calibration-{factor:g}.yaml"
    changed_calibration = replace(calibration, **changes)
    save_calibration(changed_calibration, path)
    return path


def demo_recording(entered_kg: float | None = None, at: datetime = RECORDED) -> Recording:
    """Recording of the demo cell's drives, without losses, some samples saturated."""
    serials = tuple(range(1001, 1007))
    return Recording(
        at.timestamp(), entered_kg, serials, (0.0, 0.1, 0.0, 0.0, 1.9, 0.0), 0, (0,) * 6, None
    )


def recorded(calibration: Calibration, at: datetime) -> Calibration:
    """The same, of logs that were recorded at another time."""
    return with_recordings(calibration, recorded_s=at.timestamp())


def with_recordings(calibration: Calibration, **changes: object) -> Calibration:
    """The same calibration with changes in how every log was recorded."""
    reported = [(source, source.recording) for source in calibration.sources]
    sources = tuple(
        source if recording is None else replace(source, recording=replace(recording, **changes))  # type: ignore[arg-type]
        for source, recording in reported
    )
    return replace(
        calibration,
        sources=sources,
    )


def of_first_axes(calibration: Calibration, count: int) -> Calibration:
    """The same of so many axes."""

    def first(error: RelativeError | None) -> RelativeError | None:
        if error is None:
            return None
        return replace(error, axes=error.axes[:count])

    error = calibration.relative_error_percent
    relative_error_percent = replace(error, axes=error.axes[:count])
    holdout_error_percent = first(calibration.holdout_error_percent)
    gains = calibration.gains[:count]
    cut = replace(
        calibration,
        gains=gains,
        relative_error_percent=relative_error_percent,
        holdout_error_percent=holdout_error_percent,
        nameplate_holdout_error_percent=first(calibration.nameplate_holdout_error_percent),
    )
    serials = tuple(range(1001, 1001 + count))
    saturated_percent = (0.0,) * count
    missing = (0,) * count
    return with_recordings(
        cut,
        serials=serials,
        saturated_percent=saturated_percent,
        missing=missing,
    )


_numbers = st.floats(-1e30, 1e30)
_deviations = st.floats(0.0, 1e30)
_texts = st.text(max_size=12)
_parameters = st.builds(Parameter, _texts, _numbers, _deviations, _texts)
_errors = st.builds(RelativeError, st.lists(_deviations, max_size=3).map(tuple), _deviations)
_percents = st.lists(st.floats(0.0, 100.0), max_size=3).map(tuple)
_recordings = st.builds(
    Recording,
    recorded_s=st.none() | _numbers,
    entered_kg=st.none() | _numbers,
    serials=st.lists(st.none() | st.integers(0, 2**32 - 1), max_size=3).map(tuple),
    saturated_percent=_percents,
    lost_cycles=st.integers(0, 10**9),
    missing=st.lists(st.integers(0, 10**9), max_size=3).map(tuple),
    controller_sha256=st.none() | _texts,
)
_sources = st.builds(
    Source,
    name=_texts,
    sha256=_texts,
    role=_texts,
    partial=st.booleans(),
    payload=st.none() | _texts,
    mass_kg=st.none() | _numbers,
    recording=st.none() | _recordings,
)
_effects = st.builds(
    AcceptedEffect,
    name=_texts,
    axis=_texts,
    settings=st.dictionaries(_texts, _numbers, max_size=3),
    coefficients=st.lists(_parameters, max_size=2).map(tuple),
    error_before_percent=_deviations,
    error_after_percent=_deviations,
    ambiguity=st.lists(_texts, max_size=2).map(tuple),
)
calibrations = st.builds(
    Calibration,
    cell=_texts,
    method=st.sampled_from(("ls", "wls", "tls", "ml")),
    gains=st.lists(
        st.builds(Gain, _texts, _numbers, _deviations, _texts, _numbers), max_size=4
    ).map(tuple),
    parameters=st.lists(_parameters, max_size=4).map(tuple),
    effects=st.lists(_effects, max_size=2).map(tuple),
    covariance_factor=st.none() | st.lists(_numbers, max_size=3).map(lambda row: (tuple(row),)),
    relative_error_percent=_errors,
    holdout_error_percent=st.none() | _errors,
    condition=_deviations,
    rows=st.integers(min_value=0, max_value=10**9),
    filter=st.dictionaries(_texts, _numbers | st.lists(_numbers, max_size=3), max_size=3),
    sources=st.lists(_sources, max_size=2).map(tuple),
    configuration_sha256=_texts,
    created=_texts,
    software=_texts,
    nameplate_holdout_error_percent=st.none() | _errors,
    recording_configuration_sha256=st.none() | _texts,
    current_residual=st.none() | st.lists(_deviations, max_size=3).map(tuple),
)
