"""Gates of the fit as a whole: whose it is, and whether it tells more of held-out data than the nameplate does."""

from __future__ import annotations

import math

from daq.configuration.apply_policy import ApplyPolicy
from daq.write_back.gates import Gate, Refusal
from ident.calibration import Calibration
from ident.relative_error import RelativeError

NOISE = 1.01
"""Share of the nameplate's error that a calibration may have: where the nameplate is true, the two differ by 0.1 %."""


def fit_refusals(
    calibration: Calibration, cell: str, configuration_sha256: str | None, policy: ApplyPolicy
) -> tuple[Refusal, ...]:
    """Closed gates of the calibration as a whole.

    Args:
        calibration: to be written.
        cell: name of the cell whose controller it goes to.
        configuration_sha256: digest of that cell's configuration now, None where it is not to be compared.
        policy: bounds.
    """
    closed = []
    if calibration.cell != cell:
        closed.append(
            Refusal(Gate.CELL, "calibration", f"cell {calibration.cell!r}", f"cell {cell!r}", "give its own --cell")
        )
    if configuration_sha256 is not None and calibration.configuration_sha256 != configuration_sha256:
        closed.append(
            Refusal(
                Gate.CONFIGURATION,
                "calibration",
                f"recorded with cell configuration {calibration.configuration_sha256[:12] or 'unknown'}…",
                f"{configuration_sha256[:12]}…, the cell's configuration now",
                "record again, or see what changed since and say so with --configuration-changed",
            )
        )
    return (*closed, *_error_refusals(calibration, policy), *_effect_refusals(calibration))


def _error_refusals(calibration: Calibration, policy: ApplyPolicy) -> list[Refusal]:
    trained, held = calibration.relative_error_percent, calibration.holdout_error_percent
    still = [] if held is None else [_still(axis) for axis in _axes_without_figure(calibration, held)]
    numbers = [*trained.axes, trained.total]
    if held is not None:
        numbers += [*(number for number in held.axes if not math.isnan(number)), held.total]
    if not all(map(math.isfinite, numbers)):
        return [
            *still,
            Refusal(
                Gate.NOT_FINITE, "calibration", "a relative error that is no number", "finite", "fit the logs again"
            ),
        ]
    return [*still, *_size_refusals(calibration, policy)]


def _size_refusals(calibration: Calibration, policy: ApplyPolicy) -> list[Refusal]:
    held, nameplate = calibration.holdout_error_percent, calibration.nameplate_holdout_error_percent
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
    if held is not None and nameplate is not None and not held.total <= NOISE * nameplate.total:
        closed.append(
            Refusal(
                Gate.HOLDOUT,
                "calibration",
                f"{held.total:.2f} % of the torques of the run that was held out",
                f"less than the {nameplate.total:.2f} % that the nameplate's gains leave of it",
                "the controller is better off without this calibration: was the payload as declared in every run?",
            )
        )
    return closed


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
