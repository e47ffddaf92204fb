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

#: Gains [Nm/A] by the data sheets, and as the paper's Table 4 has them; J1 to J6.
NAMEPLATE = (32.96, 32.96, 25.65, -11.52, 18.48, 7.68)
IDENTIFIED = (33.9, 32.4, 24.2, -9.21, 16.3, 6.79)
AXES = ("J1", "J2", "J3", "J4", "J5", "J6")
RECORDED = datetime(2025, 1, 2, 2, 0, 0, tzinfo=UTC)
KEYS = {axis: f"drives.{axis}.gain" for axis in AXES}
NONE_MISSING = (0,) * len(AXES)  #: answers that each axis lacks


def demo_calibration() -> Calibration:
    """Calibration of the demo cell, with the gains of the paper's Table 4 and σ of 0.4 %."""
    relative_error = RelativeError(
        axes=(3.1, 2.8, 3.4, 4.0, 5.5, 4.9),
        total=3.2,
    )
    holdout_error = RelativeError(
        axes=(3.2, 2.9, 3.5, 4.1, 5.6, 5.0),
        total=3.3,
    )
    nameplate_holdout_error = RelativeError(
        axes=(4.2, 3.9, 4.5, 5.1, 6.6, 6.0),
        total=4.3,
    )
    load_friction = _demo_load_friction()
    standstill_rad_s = [0.03] * len(AXES)
    conditioning: dict[str, Any] = {
        "position_cutoff_hz": 40.0,
        "standstill_rad_s": standstill_rad_s,
    }
    current_residual = (0.03, 0.05, 0.02, 0.02, 0.01, 0.01)
    digest = "c" * 64
    return Calibration(
        cell="demo",
        method="ml",
        gains=_demo_gains(),
        parameters=_demo_parameters(),
        effects=(load_friction,),
        relative_error_percent=relative_error,
        holdout_error_percent=holdout_error,
        condition=812.0,
        rows=14400,
        filter=conditioning,
        sources=_demo_sources(),
        configuration_sha256=digest,
        created="2025-01-02T03:04:05+00:00",
        software="drivegain 0.1.0",
        nameplate_holdout_error_percent=nameplate_holdout_error,
        recording_configuration_sha256=None,
        current_residual=current_residual,
    )


def _demo_gains() -> tuple[Gain, ...]:
    gains = []
    for axis, value, nameplate in zip(AXES, IDENTIFIED, NAMEPLATE, strict=True):
        std = 0.004 * abs(value)
        gain = Gain(axis, value, std, "Nm/A", nameplate)
        gains.append(gain)
    return tuple(gains)


def _demo_parameters() -> tuple[Parameter, ...]:
    inertia = Parameter("ZZ1R", 1.25, 0.01, "kg m²")
    offset = Parameter("off3", 0.0, 0.02, "Nm")
    return inertia, offset


def _demo_load_friction() -> AcceptedEffect:
    coefficient = Parameter("c", 0.12, 0.002, "1")
    return AcceptedEffect(
        name="load-friction",
        axis="J3",
        settings={"power": 1.0},
        coefficients=(coefficient,),
        error_before_percent=6.1,
        error_after_percent=3.4,
        ambiguity=(),
    )


def _demo_sources() -> tuple[Source, ...]:
    """A log without a payload, one with a disc, and one of the disc for the holdout."""
    unloaded = Source(
        name="unloaded",
        sha256="a" * 64,
        role="fit",
        recording=demo_recording(),
    )
    loaded = _demo_source_of_disc("loaded", "b" * 64, "fit", entered_kg=4.592)
    held_out = _demo_source_of_disc("held-out", "d" * 64, "holdout", entered_kg=4.588)
    return unloaded, loaded, held_out


def _demo_source_of_disc(name: str, digest: str, role: str, entered_kg: float) -> Source:
    """A log with the disc, with its mass as the scale has it."""
    recording = demo_recording(entered_kg)
    return Source(
        name=name,
        sha256=digest,
        role=role,
        partial=False,
        payload="disc",
        mass_kg=4.59,
        recording=recording,
    )


def calibration_for(cell_file: Path, factor: float = 1.0, **changes: Any) -> Path:
    """A calibration that every gate of the demo cell lets through, its gains times a factor;
    its file.
    """
    declared = load_cell(cell_file)
    now = datetime.now(UTC)
    an_hour_ago = now - timedelta(hours=1)
    demo = recorded(demo_calibration(), an_hour_ago)
    gains = [replace(gain, value=gain.value * factor) for gain in demo.gains]
    of_cell = replace(
        demo,
        created=now.isoformat(),
        configuration_sha256=declared.digest,
        recording_configuration_sha256=declared.recording_digest,
        gains=tuple(gains),
    )
    calibration = replace(of_cell, **changes)
    path = cell_file.parent / f"calibration-{factor:g}.yaml"
    save_calibration(calibration, path)
    return path


def demo_recording(entered_kg: float | None = None, at: datetime = RECORDED) -> Recording:
    """Recording of the demo cell's drives, without losses, some samples saturated."""
    return Recording(
        recorded_s=at.timestamp(),
        entered_kg=entered_kg,
        serials=_demo_serials(len(AXES)),
        saturated_percent=(0.0, 0.1, 0.0, 0.0, 1.9, 0.0),
        lost_cycles=0,
        missing=NONE_MISSING,
        controller_sha256=None,
    )


def _demo_serials(count: int) -> tuple[int, ...]:
    """Serial numbers of so many amplifiers."""
    numbers = range(1001, 1001 + count)
    return tuple(numbers)


def recorded(calibration: Calibration, at: datetime) -> Calibration:
    """The same, of logs that were recorded at another time."""
    return with_recordings(calibration, recorded_s=at.timestamp())


def with_recordings(calibration: Calibration, **changes: Any) -> Calibration:
    """The same calibration with changes in how every log was recorded."""

    def changed(source: Source) -> Source:
        if source.recording is None:
            return source
        recording = replace(source.recording, **changes)
        return replace(source, recording=recording)

    sources = [changed(source) for source in calibration.sources]
    return replace(calibration, sources=tuple(sources))


def of_first_axes(calibration: Calibration, count: int) -> Calibration:
    """The same of so many axes."""
    relative_error = _error_of_first_axes(calibration.relative_error_percent, count)
    holdout_error = _optional_error(calibration.holdout_error_percent, count)
    nameplate_holdout_error = _optional_error(calibration.nameplate_holdout_error_percent, count)
    cut = replace(
        calibration,
        gains=calibration.gains[:count],
        relative_error_percent=relative_error,
        holdout_error_percent=holdout_error,
        nameplate_holdout_error_percent=nameplate_holdout_error,
    )
    return with_recordings(
        cut,
        serials=_demo_serials(count),
        saturated_percent=(0.0,) * count,
        missing=(0,) * count,
    )


def _error_of_first_axes(error: RelativeError, count: int) -> RelativeError:
    axes = error.axes[:count]
    return replace(error, axes=axes)


def _optional_error(error: RelativeError | None, count: int) -> RelativeError | None:
    if error is None:
        return None
    return _error_of_first_axes(error, count)


def _tuples(entries: st.SearchStrategy[Any], max_size: int) -> st.SearchStrategy[tuple[Any, ...]]:
    """Tuples of no entry up to so many."""
    lists = st.lists(entries, max_size=max_size)
    return lists.map(tuple)


_numbers = st.floats(-1e30, 1e30)
_deviations = st.floats(0.0, 1e30)
_percents = st.floats(0.0, 100.0)
_counts = st.integers(0, 10**9)
_serials = st.integers(0, 2**32 - 1)
_texts = st.text(max_size=12)
_optional_numbers = st.none() | _numbers
_optional_texts = st.none() | _texts
_gains = st.builds(Gain, _texts, _numbers, _deviations, _texts, _numbers)
_parameters = st.builds(Parameter, _texts, _numbers, _deviations, _texts)
_errors = st.builds(RelativeError, _tuples(_deviations, 3), _deviations)
_optional_errors = st.none() | _errors
_optional_serials = st.none() | _serials
_recordings = st.builds(
    Recording,
    recorded_s=_optional_numbers,
    entered_kg=_optional_numbers,
    serials=_tuples(_optional_serials, 3),
    saturated_percent=_tuples(_percents, 3),
    lost_cycles=_counts,
    missing=_tuples(_counts, 3),
    controller_sha256=_optional_texts,
)
_optional_recordings = st.none() | _recordings
_sources = st.builds(
    Source,
    name=_texts,
    sha256=_texts,
    role=_texts,
    partial=st.booleans(),
    payload=_optional_texts,
    mass_kg=_optional_numbers,
    recording=_optional_recordings,
)
_settings = st.dictionaries(_texts, _numbers, max_size=3)
_effects = st.builds(
    AcceptedEffect,
    name=_texts,
    axis=_texts,
    settings=_settings,
    coefficients=_tuples(_parameters, 2),
    error_before_percent=_deviations,
    error_after_percent=_deviations,
    ambiguity=_tuples(_texts, 2),
)
_methods = st.sampled_from(("ls", "wls", "tls", "ml"))
_covariance_factors = st.tuples(_tuples(_numbers, 3))
"""Factors of one row."""
_optional_factors = st.none() | _covariance_factors
_filter_values = _numbers | st.lists(_numbers, max_size=3)
_filters = st.dictionaries(_texts, _filter_values, max_size=3)
_optional_residuals = st.none() | _tuples(_deviations, 3)
calibrations = st.builds(
    Calibration,
    cell=_texts,
    method=_methods,
    gains=_tuples(_gains, 4),
    parameters=_tuples(_parameters, 4),
    effects=_tuples(_effects, 2),
    covariance_factor=_optional_factors,
    relative_error_percent=_errors,
    holdout_error_percent=_optional_errors,
    condition=_deviations,
    rows=_counts,
    filter=_filters,
    sources=_tuples(_sources, 2),
    configuration_sha256=_texts,
    created=_texts,
    software=_texts,
    nameplate_holdout_error_percent=_optional_errors,
    recording_configuration_sha256=_optional_texts,
    current_residual=_optional_residuals,
)
