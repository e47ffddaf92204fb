"""The table of all gates, in the order in which they are checked and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from daq.config.policy import ApplyPolicy
from daq.writeback.gates import fit, logs, target
from daq.writeback.gates.gate import Gate, GateContext, Refusal
from daq.writeback.request import GateFinding

_LIMITS = ApplyPolicy()


#: Yields one finding for each reason to refuse
Check = Callable[[GateContext], Iterator[GateFinding]]


@dataclass(frozen=True, slots=True)
class GateRow:
    """One gate."""

    gate: Gate  #: its name in messages, in the audit and in `--json`
    checks: tuple[Check, ...]  #: the condition in code; two where the gate compares two things
    remedy: str  #: what to do
    #: default limit with its key in `policy: {apply: ...}`; empty where there is none
    limit: str = ""

    @property
    def text(self) -> str:
        """The condition in words: the first paragraph of each check's docstring."""
        words: list[str] = []
        for check in self.checks:
            first_paragraph, *_ = (check.__doc__ or "").split("\n\n", 1)
            words += first_paragraph.split()
        return " ".join(words)


GATES: tuple[GateRow, ...] = (
    GateRow(Gate.NOT_IDENTIFIED, (target.identified,), "fit with a loaded run and free gains"),
    GateRow(
        Gate.CELL,
        (fit.cell, fit.former_name),
        "give the cell file of that robot, with its present name",
    ),
    GateRow(
        Gate.CONFIGURATION,
        (fit.configuration,),
        "record again, or review and pass `--configuration-changed`",
    ),
    GateRow(
        Gate.DESCRIPTION,
        (fit.description, fit.encoders),
        "correct the cell file and fit again, or let `drivegain residual` correct it",
        f"`max_encoder_misfit_mrad: {_LIMITS.max_encoder_misfit_mrad:g}` of encoders that "
        "nothing explains",
    ),
    GateRow(Gate.NOT_FINITE, (fit.finite_errors, target.finite_gains), "fit again"),
    GateRow(Gate.HOLDOUT_STILL, (fit.holdout_motion,), "hold out a run in which all axes move"),
    GateRow(
        Gate.ERROR,
        (fit.error,),
        "check drive train, roles, payload, units",
        f"`max_error_percent: {_LIMITS.max_error_percent:g}`, `max_axis_error_percent: "
        f"{_LIMITS.max_axis_error_percent:g}`",
    ),
    GateRow(
        Gate.HOLDOUT,
        (fit.holdout, fit.holdout_log),
        "was the payload as declared in every run, and each drive the same?",
        f"{fit.NOISE:g} × theirs, {fit.AXIS_NOISE:g} × on an axis; `holdout: optional`, `required` "
        "with `by: job`",
    ),
    GateRow(Gate.EFFECT, (fit.effect,), "fit without this effect"),
    GateRow(Gate.UNIT, (target.unit,), "fit again with `--cell`"),
    GateRow(Gate.SOURCES, (logs.sources, logs.roles), "fit the logs again"),
    GateRow(Gate.PARTIAL, (logs.partial,), "record again"),
    GateRow(Gate.LOSSY, (logs.losses,), "record again with less load"),
    GateRow(
        Gate.STALE,
        (logs.age,),
        "record again; set the clocks",
        f"`max_age_days: {_LIMITS.max_age_days:g}`, `null` for any",
    ),
    GateRow(
        Gate.SERIAL,
        (logs.serials,),
        "record again with the present drive",
        "`identity.serial` of the axis",
    ),
    GateRow(
        Gate.SATURATED,
        (logs.saturation,),
        "slower moves, smaller payload",
        f"`max_saturated_percent: {_LIMITS.max_saturated_percent:g}`",
    ),
    GateRow(Gate.MASS, (logs.mass,), "weigh it again", "`mass_tolerance_kg` of the payload"),
    GateRow(
        Gate.BASE,
        (target.base,),
        "review the target and a dry run, then pass the `--base` that it prints",
    ),
    GateRow(
        Gate.SIGNATURE,
        (target.signature,),
        "have them review and `drivegain sign`",
        f"`signatures: {_LIMITS.signatures}`",
    ),
    GateRow(
        Gate.UNCERTAINTY,
        (target.uncertainty,),
        "longer recording, more exciting moves, a heavier payload",
        f"`max_std_percent: {_LIMITS.max_std_percent:g}`",
    ),
    GateRow(Gate.SIGN, (target.same_sign,), "check directions of encoder and current"),
    GateRow(
        Gate.CHANGE,
        (target.change_bound,),
        "check scale of the current (RMS or peak), mass of the payload",
        f"`max_change_percent: {_LIMITS.max_change_percent:g}`; per axis in the gain's unit "
        f"`max_change: {{J4: 2.0}}`",
    ),
    GateRow(
        Gate.NAMEPLATE,
        (target.nameplate_bound, target.same_nameplate),
        "check drive profile, nameplate, mass of the payload",
        f"`max_nameplate_percent: {_LIMITS.max_nameplate_percent:g}`",
    ),
)


def check_gates(context: GateContext) -> tuple[Refusal, ...]:
    """Check every gate and return the refusals; none where all of them pass.

    Raises:
        UsageError: the value of --base is no digest.
        ConfigurationInconsistent: a signer's public key is none.
    """
    refusals: list[Refusal] = []
    for row in GATES:
        for check in row.checks:
            for finding in check(context):
                refusals.append(Refusal(row.gate, *finding))
    return tuple(refusals)
