"""Gates of the fit as a whole: whose it is, and whether it tells more of held-out data than the nameplate does."""

from __future__ import annotations

import math
from collections.abc import Iterator

from daq.config.policy import ApplyPolicy
from daq.writeback.gates.table import Gate, Refusal
from ident.calibration import Calibration
from ident.estimators.estimate import RelativeError

NOISE, AXIS_NOISE = 1.01, 1.02
"""Share of the nameplate's error that a calibration may have, in total and on an axis: where the nameplate is true, the
two differ by 0.1 % and 0.3 % (`tests.studies.holdout_study`)."""


def fit_refusals(
    calibration: Calibration,
    cell: str,
    configuration_sha256: str | None,
    policy: ApplyPolicy,
    recording_configuration_sha256: str | None = None,
) -> tuple[Refusal, ...]:
    """Closed gates of the calibration as a whole.

    Args:
        calibration: to be written.
        cell: name of the cell whose controller it goes to.
        configuration_sha256: digest of that cell's configuration now, None where it is not to be compared.
        policy: bounds.
        recording_configuration_sha256: of what of that configuration a recording depends on (`Cell.recording_digest`).
    """
    closed = []
    if calibration.cell != cell:
        closed.append(
            Refusal(Gate.CELL, "calibration", f"cell {calibration.cell!r}", f"cell {cell!r}", "give its own --cell")
        )
    if configuration_sha256 is not None:
        closed += _configuration_refusals(calibration, configuration_sha256, recording_configuration_sha256)
    return (*closed, *_error_refusals(calibration, policy), *_effect_refusals(calibration))


def _configuration_refusals(calibration: Calibration, whole: str, recording: str | None) -> list[Refusal]:
    found, expected = calibration.configuration_sha256, whole
    then = calibration.recording_configuration_sha256
    # A calibration of an earlier version tells the digest of the whole configuration alone, and is held to it.
    if then is not None and recording is not None:
        found, expected = then, recording
    if found == expected:
        return []
    return [
        Refusal(
            Gate.CONFIGURATION,
            "calibration",
            f"recorded with cell configuration {found[:12] or 'unknown'}…",
            f"{expected[:12]}…, the cell's configuration now",
            "record again, or see what changed since and say so with --configuration-changed",
        )
    ]


def _error_refusals(calibration: Calibration, policy: ApplyPolicy) -> list[Refusal]:
    trained, held = calibration.relative_error_percent, calibration.holdout_error_percent
    still = [] if held is None else [_still(axis) for axis in _axes_without_figure(calibration, held)]
    numbers = [*trained.axes, trained.total]
    if held is not None:
        numbers += [*(number for number in held.axes if not math.isnan(number)), held.total]
    if not all(0.0 <= number < math.inf for number in numbers):
        return [
            *still,
            Refusal(
                Gate.NOT_FINITE,
                "calibration",
                "a relative error that is no number, or below zero",
                "finite numbers from 0 %",
                "fit the logs again",
            ),
        ]
    return [*still, *_size_refusals(calibration, policy), *_holdout_refusals(calibration, policy)]


def _size_refusals(calibration: Calibration, policy: ApplyPolicy) -> list[Refusal]:
    held = calibration.holdout_error_percent
    error = calibration.relative_error_percent if held is None else held
    closed = []
    if error.total > policy.max_error_percent:
        closed.append(
            Refusal(
                Gate.ERROR,
                "calibration",
                f"a relative error of {error.total:.1f} % of the torques",
                f"at most {policy.max_error_percent:g} %",
                "the model does not describe this robot: check drive train, roles, payload and units",
            )
        )
    names = [gain.axis for gain in calibration.gains]
    closed += [
        Refusal(
            Gate.ERROR,
            name,
            f"a relative error of {number:.1f} % of this axis's torque",
            f"at most {policy.max_axis_error_percent:g} %",
            "the model does not describe this axis: check its drive train, drive, current and direction",
        )
        for name, number in zip(names, error.axes, strict=False)
        if number > policy.max_axis_error_percent
    ]
    counts = {len(one.axes) for one in (calibration.relative_error_percent, held) if one is not None}
    closed += [
        Refusal(
            Gate.ERROR,
            "calibration",
            f"relative errors of {count} axes",
            f"one of each of the {len(names)} axes",
            "fit the logs again",
        )
        for count in sorted(counts)
        if count < len(names)
    ]
    return closed


def _holdout_refusals(calibration: Calibration, policy: ApplyPolicy) -> list[Refusal]:
    held, nameplate = calibration.holdout_error_percent, calibration.nameplate_holdout_error_percent
    if held is None:
        if not policy.requires_holdout:
            return []
        return [
            Refusal(
                Gate.HOLDOUT,
                "calibration",
                "no run that was held out",
                "a run that puts the gains to the test, as the cell wants (`holdout: required`, or `by: job`)",
                "fit the logs again, with --holdout for a run that the fit does not see",
            )
        ]
    if nameplate is None:
        return [
            Refusal(
                Gate.HOLDOUT,
                "calibration",
                "a hold-out that was not compared with the nameplate",
                "what the nameplate's gains leave of it",
                "fit the logs again with free gains and --holdout",
            )
        ]
    closed = []
    if not held.total <= NOISE * nameplate.total:
        closed.append(
            Refusal(
                Gate.HOLDOUT,
                "calibration",
                f"{held.total:.2f} % of the torques of the run that was held out",
                f"less than the {nameplate.total:.2f} % that the nameplate's gains leave of it",
                "the controller is better off without this calibration: was the payload as declared in every run?",
            )
        )
    names = [gain.axis for gain in calibration.gains]
    for name, left, before in zip(names, held.axes, _as_long(nameplate.axes, len(names)), strict=False):
        # Of an axis at rest there is a refusal already; NaN of the nameplate alone is no figure to be better than.
        if not math.isnan(left) and not left <= AXIS_NOISE * before:
            closed.append(
                Refusal(
                    Gate.HOLDOUT,
                    name,
                    f"{left:.2f} % of this axis's torque in the run that was held out",
                    f"less than the {before:.2f} % that the nameplate's gains leave of it",
                    "the axis is better off without this gain: was its drive, or the scale of its current, another one "
                    "in some of the runs?",
                )
            )
    return closed


def _as_long(axes: tuple[float, ...], count: int) -> tuple[float, ...]:
    return (*axes, *(math.nan for _ in range(count - len(axes))))


def _effect_refusals(calibration: Calibration) -> list[Refusal]:
    return [
        Refusal(
            Gate.EFFECT,
            f"effect {effect.name} on {effect.axis}",
            f"{effect.error_after_percent:.2f} % on held-out data with it, {effect.error_before_percent:.2f} % without",
            "an effect that lowers it",
            "fit without this effect",
        )
        for effect in calibration.effects
        if not effect.error_after_percent < effect.error_before_percent
    ]


def _axes_without_figure(calibration: Calibration, held: RelativeError) -> list[str]:
    names = [gain.axis for gain in calibration.gains]
    return [name for name, number in zip(names, held.axes, strict=False) if math.isnan(number)]


def _still(axis: str) -> Refusal:
    return Refusal(
        Gate.HOLDOUT_STILL,
        axis,
        "no motion of this axis in the run that was held out",
        "a run that puts every gain to the test",
        "hold out a run in which all axes move",
    )


# Gates of the logs together: what each was used for, and whether all of them can tell what is said of them.


_FIT, _HOLDOUT = "fit", "holdout"


def role_refusals(calibration: Calibration) -> Iterator[Refusal]:
    """Closed where the roles of the logs do not bear what the calibration says.

    Args:
        calibration: to be written, with at least one log.
    """
    sources = calibration.sources
    for source in sources:
        if source.role not in {_FIT, _HOLDOUT}:
            yield Refusal(
                Gate.SOURCES,
                f"log {source.name}",
                f"the role {source.role!r}",
                f"{_FIT!r} or {_HOLDOUT!r}",
                "fit the logs again",
            )
    fitted = [source for source in sources if source.role == _FIT]
    held = [source for source in sources if source.role == _HOLDOUT]
    if not fitted:
        yield Refusal(Gate.SOURCES, "calibration", "no log that was fitted", "at least one", "fit the logs again")
    elif not any(source.payload for source in fitted):
        yield Refusal(
            Gate.SOURCES,
            "calibration",
            "no payload in any log that was fitted",
            "one with a weighed payload, which sets the scale of the gains",
            "fit a loaded run too",
        )
    elif len(fitted) < 2:
        yield Refusal(
            Gate.SOURCES,
            "calibration",
            "one log that was fitted",
            "one without load and one with a weighed payload, or more",
            "fit both",
        )
    yield from _repeated(calibration)
    yield from _figures(calibration, bool(held))


def _repeated(calibration: Calibration) -> Iterator[Refusal]:
    """A log that was held out of nothing, or counts twice."""
    met: dict[str, str] = {}
    for source in calibration.sources:
        if source.sha256 in met:
            yield Refusal(
                Gate.SOURCES,
                f"log {source.name}",
                f"the same recording as log {met[source.sha256]}",
                "every recording once, in the fit or held out",
                "fit the logs again, each once",
            )
        met.setdefault(source.sha256, source.name)


def _figures(calibration: Calibration, held_out: bool) -> Iterator[Refusal]:
    """A figure without a log is nobody's; a log without its figure hides one."""
    has_holdout = calibration.holdout_error_percent is not None
    if has_holdout != held_out:
        yield Refusal(
            Gate.HOLDOUT,
            "calibration",
            "an error on held-out data, and no log of them"
            if has_holdout
            else "a log that was held out, and no error on it",
            "both or neither",
            "fit the logs again",
        )
