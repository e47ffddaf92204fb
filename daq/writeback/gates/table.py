"""The table of all gates, in the order in which they are checked and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from daq.config.policy import ApplyPolicy
from daq.writeback.gates import fit, logs, target
from daq.writeback.gates.gate import Gate, GateContext, Refusal
from daq.writeback.request import Finding

_LIMITS = ApplyPolicy()


Check = Callable[[GateContext], Iterator[Finding]]  #: Yields one finding for each reason to refuse


@dataclass(frozen=True, slots=True)
class GateRow:
    """One gate."""

    gate: Gate  #: its name in messages, in the audit and in `--json`
    fails_if: str  #: what it compares, as the condition under which it refuses
    limit: str  #: default limit with its key in `policy: {apply: ...}`; empty where there is none
    remedy: str  #: what to do
    check: Check  #: the condition in code
    further_check: Check | None = None  #: a second part of it, where the gate compares two things


GATES: tuple[GateRow, ...] = (
    GateRow(Gate.CELL, "a calibration of another cell", "", "use its own `--cell`", fit.cell),
    GateRow(
        Gate.CONFIGURATION,
        "URDF, drive profile or cell file changed since the recording, in what a recording depends on",
        "",
        "record again, or review and pass `--configuration-changed`",
        fit.configuration,
    ),
    GateRow(
        Gate.NOT_FINITE,
        "a gain, its σ, the number in the controller, the nameplate or an error is not finite, an error or σ is "
        "negative, or a gain is zero",
        "",
        "fit again",
        fit.finite_errors,
        target.finite_gains,
    ),
    GateRow(
        Gate.HOLDOUT_STILL,
        "an axis did not move in the held-out run, so nothing tests its gain",
        "",
        "hold out a run in which all axes move",
        fit.holdout_motion,
    ),
    GateRow(
        Gate.ERROR,
        "the relative error of the torques is too large, on the held-out run if there is one; in total, or on an axis",
        f"`max_error_percent: {_LIMITS.max_error_percent:g}`, "
        f"`max_axis_error_percent: {_LIMITS.max_axis_error_percent:g}`",
        "check drive train, roles, payload, units",
        fit.error,
    ),
    GateRow(
        Gate.HOLDOUT,
        "the held-out error is worse than with the nameplate's gains, in total or on an axis, or was not compared; or "
        "it is missing and the cell requires it; or error and log do not both exist",
        f"{fit.NOISE:g} × theirs, {fit.AXIS_NOISE:g} × on an axis; `holdout: optional`, `required` with `by: job`",
        "was the payload as declared in every run, and each drive the same?",
        fit.holdout,
        fit.holdout_log,
    ),
    GateRow(
        Gate.EFFECT, "an effect does not lower the error on held-out data", "", "fit without this effect", fit.effect
    ),
    GateRow(Gate.UNIT, "a gain in another unit than the cell's", "", "fit again with `--cell`", target.unit),
    GateRow(
        Gate.SOURCES,
        "no logs, a log without digest or recording data (a calibration of an earlier drivegain), or not for "
        "every axis; only one log in the fit, none with a payload, one recording twice, a role other than `fit` and "
        "`holdout`",
        "",
        "fit the logs again",
        logs.sources,
        logs.roles,
    ),
    GateRow(Gate.PARTIAL, "a log was salvaged, or its losses were accepted", "", "record again", logs.partial),
    GateRow(Gate.LOSSY, "cycles or answers are missing in a log", "", "record again with less load", logs.losses),
    GateRow(
        Gate.STALE,
        "a log is too old, dated in the future, or has no valid date (imports)",
        f"`max_age_days: {_LIMITS.max_age_days:g}`, `null` for any",
        "record again; set the clocks",
        logs.age,
    ),
    GateRow(
        Gate.SERIAL,
        "a drive is not the one in the cell file, or differs between the logs of the fit",
        "`identity.serial` of the axis",
        "record again with the present drive",
        logs.serials,
    ),
    GateRow(
        Gate.SATURATED,
        "a limit acted in too many samples of an axis",
        f"`max_saturated_percent: {_LIMITS.max_saturated_percent:g}`",
        "slower moves, smaller payload",
        logs.saturation,
    ),
    GateRow(
        Gate.MASS,
        "entered only once; or the two entries, or the fit's mass and the cell file's present one, differ by more than "
        "the tolerance",
        "`mass_tolerance_kg` of the payload",
        "weigh it again",
        logs.mass,
    ),
    GateRow(
        Gate.BASE,
        "the controller's file differs from the one at the recording, a drive has another gain than drivegain left "
        "there, or either differs from `--base`",
        "",
        "review the target and a dry run, then pass the `--base` that it prints",
        target.base,
    ),
    GateRow(
        Gate.SIGNATURE,
        "too few signatures, or `--by` is neither a signer nor the login",
        f"`signatures: {_LIMITS.signatures}`",
        "have them review and `drivegain sign`",
        target.signature,
    ),
    GateRow(
        Gate.NOT_IDENTIFIED,
        "the fit held the gain fixed (σ = 0)",
        "",
        "fit with a loaded run and free gains",
        target.identified,
    ),
    GateRow(
        Gate.UNCERTAINTY,
        "σ too large",
        f"`max_std_percent: {_LIMITS.max_std_percent:g}`",
        "longer recording, more exciting moves, a heavier payload",
        target.uncertainty,
    ),
    GateRow(
        Gate.SIGN,
        "the gain's sign differs from the controller's or the nameplate's",
        "",
        "check directions of encoder and current",
        target.sign,
    ),
    GateRow(
        Gate.CHANGE,
        "too far from the number in the controller",
        f"`max_change_percent: {_LIMITS.max_change_percent:g}`; per axis in the gain's unit `max_change: {{J4: 2.0}}`",
        "check scale of the current (RMS or peak), mass of the payload",
        target.change_bound,
    ),
    GateRow(
        Gate.NAMEPLATE,
        "too far from the nameplate, or compared with another nameplate than the cell's",
        f"`max_nameplate_percent: {_LIMITS.max_nameplate_percent:g}`",
        "check drive profile, nameplate, mass of the payload",
        target.nameplate_bound,
        target.same_nameplate,
    ),
)


def check_gates(context: GateContext) -> tuple[Refusal, ...]:
    """Check every gate and return the refusals; none where all of them pass.

    Raises:
        UsageError: the value of --base is no digest.
        ConfigurationInconsistent: a signer's public key is none.
    """
    return tuple(
        Refusal(row.gate, *finding)
        for row in GATES
        for check in (row.check, row.further_check)
        if check is not None
        for finding in check(context)
    )
