"""The table of all gates, in the order in which they are checked and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from daq.config.policy import ApplyPolicy
from daq.writeback.gates import fit, logs, target
from daq.writeback.gates.gate import Gate, GateContext, Refusal
from daq.writeback.request import Finding

_BOUNDS = ApplyPolicy()


@dataclass(frozen=True, slots=True)
class GateRow:
    """One gate.

    Attributes:
        gate: its name in messages, in the audit and in `--json`.
        closed_when: what it compares, as the condition under which it refuses.
        limit: default bound with its key in `policy: {apply: ...}`; empty where there is none.
        remedy: what to do.
        checks: each yields one finding for each reason to refuse.
    """

    gate: Gate
    closed_when: str
    limit: str
    remedy: str
    checks: tuple[Callable[[GateContext], Iterator[Finding]], ...]


GATES: tuple[GateRow, ...] = (
    GateRow(
        Gate.CELL,
        "the calibration is of another cell",
        "",
        "give its own `--cell`",
        (fit.cell,),
    ),
    GateRow(
        Gate.CONFIGURATION,
        "URDF, drive profile or cell file have changed since the recording, in what a recording depends on",
        "",
        "record again, or review the change and give `--configuration-changed`",
        (fit.configuration,),
    ),
    GateRow(
        Gate.NOT_FINITE,
        "a gain, its σ, the number in the controller, the nameplate or an error is no number; an error or σ is below "
        "zero; a gain is zero",
        "",
        "fit again",
        (fit.finite_errors, target.finite_gains),
    ),
    GateRow(
        Gate.HOLDOUT_STILL,
        "an axis does not move in the held-out run, so that nothing tests its gain",
        "",
        "hold out a run in which all axes move",
        (fit.holdout_motion,),
    ),
    GateRow(
        Gate.ERROR,
        "the relative error of the torques is too large, in total or on an axis; on the hold-out where there is one",
        f"`max_error_percent: {_BOUNDS.max_error_percent:g}`, "
        f"`max_axis_error_percent: {_BOUNDS.max_axis_error_percent:g}`",
        "check drive train, roles, payload and units",
        (fit.error,),
    ),
    GateRow(
        Gate.HOLDOUT,
        "the error on the hold-out is larger than with the nameplate's gains, in total or on an axis, or was not "
        "compared with it; the cell requires a hold-out and there is none; there is the error without its log, or the "
        "log without its error",
        f"{fit.NOISE:g} × the nameplate's, {fit.AXIS_NOISE:g} × on an axis; `holdout: optional`, `required` with "
        "`by: job`",
        "check that payload and drives were as declared in every run",
        (fit.holdout, fit.holdout_log),
    ),
    GateRow(
        Gate.EFFECT,
        "an effect does not lower the error on held-out data",
        "",
        "fit without it",
        (fit.effect,),
    ),
    GateRow(
        Gate.UNIT,
        "a gain is in another unit than the cell's",
        "",
        "fit again with `--cell`",
        (target.unit,),
    ),
    GateRow(
        Gate.SOURCES,
        "no logs; a log without digest, without data on its recording (a calibration of an earlier drivegain), or "
        "without them for every axis; one log only in the fit, none with a payload, one recording twice, or a role "
        "other than `fit` and `holdout`",
        "",
        "fit the logs again",
        (logs.sources, logs.roles),
    ),
    GateRow(
        Gate.PARTIAL,
        "a log was salvaged, or its losses were accepted",
        "",
        "record again",
        (logs.partial,),
    ),
    GateRow(
        Gate.LOSSY,
        "cycles or answers are missing in a log",
        "",
        "record again with less load on bus and computer",
        (logs.losses,),
    ),
    GateRow(
        Gate.STALE,
        "a log is too old, of the future, or has no date (imports) or an impossible one",
        f"`max_age_days: {_BOUNDS.max_age_days:g}`, `null` for any",
        "record again; set the clocks",
        (logs.age,),
    ),
    GateRow(
        Gate.SERIAL,
        "a drive is not the one that the cell file names, or not the same in all logs of the fit",
        "`identity.serial` of the axis",
        "record again with the present drive",
        (logs.serials,),
    ),
    GateRow(
        Gate.SATURATED,
        "a limit of the drive acted in too many samples of an axis",
        f"`max_saturated_percent: {_BOUNDS.max_saturated_percent:g}`",
        "slower moves, smaller payload",
        (logs.saturation,),
    ),
    GateRow(
        Gate.MASS,
        "the mass of a payload was entered once only, the two differ, or the fitted one differs from the cell file's",
        "`mass_tolerance_kg` of the payload",
        "weigh it again",
        (logs.mass,),
    ),
    GateRow(
        Gate.BASE,
        "the controller's file is not the one of the recording, a drive has another gain than drivegain left there, or "
        "the content or the change is not that of `--base`",
        "",
        "review a dry run, then repeat it with the `--base` that it prints, or that this gate prints",
        (target.base,),
    ),
    GateRow(
        Gate.SIGNATURE,
        "fewer persons have signed than the policy requires, or `--by` is neither a signer nor the login",
        f"`signatures: {_BOUNDS.signatures}`",
        "have them review the calibration and `drivegain sign` it",
        (target.signature,),
    ),
    GateRow(
        Gate.NOT_IDENTIFIED,
        "the fit held the gain fixed (σ = 0)",
        "",
        "fit with a loaded run and free gains",
        (target.identified,),
    ),
    GateRow(
        Gate.UNCERTAINTY,
        "σ is too large",
        f"`max_std_percent: {_BOUNDS.max_std_percent:g}`",
        "record longer, more exciting moves, or a heavier payload",
        (target.uncertainty,),
    ),
    GateRow(
        Gate.SIGN,
        "the gain's sign differs from that in the controller or of the nameplate",
        "",
        "check directions of encoder and current",
        (target.sign,),
    ),
    GateRow(
        Gate.CHANGE,
        "the gain is too far from the one in the controller",
        f"`max_change_percent: {_BOUNDS.max_change_percent:g}`; in the gain's unit `max_change: {{J4: 2.0}}`",
        "check scale of the current (RMS or peak) and mass of the payload",
        (target.change_bound,),
    ),
    GateRow(
        Gate.NAMEPLATE,
        "the gain is too far from the nameplate, or was compared with another nameplate than the cell's",
        f"`max_nameplate_percent: {_BOUNDS.max_nameplate_percent:g}`",
        "check drive profile, nameplate and mass of the payload",
        (target.nameplate_bound, target.same_nameplate),
    ),
)


def closed_gates(context: GateContext) -> tuple[Refusal, ...]:
    """Check every gate and return the refusals; none where all are open.

    Raises:
        UsageError: the value of --base is no digest.
        ConfigurationInconsistent: a signer's public key is none.
    """
    return tuple(Refusal(row.gate, *finding) for row in GATES for check in row.checks for finding in check(context))
