"""Gates of the target: each gain compared with the current gain, the content to be replaced,
and who approved it.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator

from daq.config.cell import CellAxis
from daq.errors import SignatureInvalid, counted
from daq.writeback.gates.gate import GateContext
from daq.writeback.request import GainChange, GainOrigin, GateFinding, parse_base, short_digest
from daq.writeback.signature import signers_of
from ident.calibration import Gain
from ident.plausible import format_at_limit

_SPELLING = 1e-9  #: Two spellings of one number are one number
_CURRENT_SCALE = (
    "check scale and amplitude (RMS or peak) of the current in the drive profile, and the "
    "payload's mass"
)


def finite_gains(context: GateContext) -> Iterator[GateFinding]:
    """Require finite numbers: gain (not zero), σ (not negative), current gain, nameplate."""
    for change in context.edit.changes:
        if not _is_finite(change):
            found = f"gain {change.new:g} ± {change.std:g}, {_others_text(change)}"
            yield change.axis, found, "finite numbers, not zero", "fit the logs again"


def identified(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a gain that the fit held fixed (σ = 0)."""
    for change in _finite_changes(context):
        if change.std == 0:
            remedy = "fit with a loaded run and free gains"
            yield change.axis, "a gain that the fit held fixed (σ = 0)", "an identified one", remedy


def uncertainty(context: GateContext) -> Iterator[GateFinding]:
    """Bound σ, relative to the gain."""
    bound = context.policy.max_std_percent
    for change in _finite_changes(context):
        if not change.std_percent <= bound:
            remedy = "record longer or more exciting moves, or a heavier payload"
            if not context.calibration.effects:
                remedy = (
                    "look for what the model lacks with `drivegain residual`, as it is in σ; "
                    f"or {remedy}"
                )
            found = f"σ {format_at_limit(change.std_percent, bound, 2)} %"
            yield change.axis, found, f"at most {bound:g} %", remedy


def same_sign(context: GateContext) -> Iterator[GateFinding]:
    """Require the sign of the current gain and of the nameplate."""
    for change in _finite_changes(context):
        if change.compared_gain == 0.0:
            yield (
                change.axis,
                f"a {change.compared_with.value} of 0",
                "a number that is not zero, with the sign of the new gain",
                "look whether this is the number of the gain; if it is, enter the nameplate there "
                "first",
            )
        elif not _keeps_sign(change):
            yield (
                change.axis,
                f"gain {change.new:g}, {_others_text(change)}",
                "the same sign",
                "check the directions of encoder and current in the cell configuration",
            )


def change_bound(context: GateContext) -> Iterator[GateFinding]:
    """Bound the change from the current gain."""
    policy = context.policy
    for change in filter(_keeps_sign, _finite_changes(context)):
        if not abs(change.change_percent) <= policy.max_change_percent:
            percent = format_at_limit(change.change_percent, policy.max_change_percent, 1, "+f")
            found = f"{percent} % from the current gain"
            yield change.axis, found, f"at most ±{policy.max_change_percent:g} %", _CURRENT_SCALE
        bound = policy.max_change.get(change.axis)
        difference = change.new - change.compared_gain
        if bound is not None and not abs(difference) <= bound:
            found = (
                f"{format_at_limit(difference, bound, 4, '+g')} {change.unit} from the current gain"
            )
            yield change.axis, found, f"at most ±{bound:g} {change.unit}", _CURRENT_SCALE


def nameplate_bound(context: GateContext) -> Iterator[GateFinding]:
    """Bound the change from the nameplate."""
    bound = context.policy.max_nameplate_percent
    for change in filter(_keeps_sign, _finite_changes(context)):
        if not abs(change.nameplate_percent) <= bound:
            yield (
                change.axis,
                f"{format_at_limit(change.nameplate_percent, bound, 1, '+f')} % from the nameplate",
                f"at most ±{bound:g} %",
                "check the drive profile, the nameplate and the payload's mass",
            )


def same_nameplate(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a comparison with another nameplate than the cell's."""
    for gain, axis in _axes_of_cell(context):
        # A nameplate that is no number has a gate of its own.
        if math.isfinite(gain.nameplate) and not math.isclose(
            gain.nameplate, axis.nameplate_gain, rel_tol=_SPELLING
        ):
            yield (
                gain.axis,
                f"compared with a nameplate of {gain.nameplate:g}",
                f"{axis.nameplate_gain:g} {axis.gain_unit}, the cell's",
                "fit the logs again with --cell: bounds and hold-out are compared with the "
                "nameplate",
            )


def unit(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a gain in another unit than the cell's."""
    for gain, axis in _axes_of_cell(context):
        if gain.unit != axis.gain_unit:
            expected = f"{axis.gain_unit!r}, as the cell file has it"
            yield gain.axis, f"a gain in {gain.unit!r}", expected, "fit the logs again with --cell"


def _is_finite(change: GainChange) -> bool:
    numbers = (change.new, change.std, change.compared_gain, change.nameplate_gain)
    return all(map(math.isfinite, numbers)) and change.new != 0 and change.std >= 0


def _finite_changes(context: GateContext) -> Iterator[GainChange]:
    return filter(_is_finite, context.edit.changes)


def _keeps_sign(change: GainChange) -> bool:
    return change.new * change.compared_gain > 0 and change.new * change.nameplate_gain > 0


def _others_text(change: GainChange) -> str:
    """Return the current gain, where the controller was read, and the nameplate,
    each with its word.
    """
    nameplate = f"nameplate {change.nameplate_gain:g}"
    if change.compared_with is GainOrigin.NAMEPLATE:
        return nameplate
    return f"{change.compared_with.value} {change.compared_gain:g}, {nameplate}"


def _axes_of_cell(context: GateContext) -> Iterator[tuple[Gain, CellAxis]]:
    if context.cell is None:
        declared = {}
    else:
        declared = {axis.name: axis for axis in context.cell.axes}
    for gain in context.calibration.gains:
        if gain.axis in declared:
            yield gain, declared[gain.axis]


def base(context: GateContext) -> Iterator[GateFinding]:
    """Require the content that the target had at the recording, or after the last write;
    or that of `--base`.
    """
    edit = context.edit
    base = context.request.base
    if base is None:
        reviewed = None
        after_digest = None
    else:
        reviewed, after_digest = parse_base(base, edit.before or b"")
    if edit.keeps_all:
        return
    if reviewed is None:
        yield from edit.unexpected
    elif reviewed != edit.base_sha256:
        yield (
            edit.subject,
            f"content {edit.base_sha256[:12]}…",
            f"{reviewed[:12]}…, as --base says",
            "the content has changed since that review: take a new dry run, without --base",
        )
    elif after_digest not in {None, short_digest(edit.after)}:
        yield (
            edit.subject,
            f"a change to {short_digest(edit.after)}…",
            f"to {after_digest}…, as --base says",
            "the calibration, the keys or the factors have changed since the dry run: take "
            "a new one",
        )


def signature(context: GateContext) -> Iterator[GateFinding]:
    """Require signatures of others than the operator; `--by` must be a signer or the login.

    Names are compared without case and blanks, and however they are encoded (NFKC). The operator's
    name must be a signer's, or the login: a look-alike of their own name would make two persons of
    one.

    Raises:
        ConfigurationInconsistent: a public key of the policy is none.
    """
    policy = context.policy
    request = context.request
    if not policy.signatures:
        return
    if request.file is None:
        subject = "calibration"
    else:
        subject = str(request.file)
    try:
        signed = (
            () if request.file is None else signers_of(request.file, policy.signers, request.signed)
        )
    except SignatureInvalid as error:
        yield error.subject, error.found, error.expected, error.remedy
        return
    *given, login = request.appliers or ("",)
    for name in given:
        known = {_as_read(other) for other in (*policy.signers, login)}
        if not name or _as_read(name) not in known:
            yield (
                "operator",
                ascii(name),
                f"one of {', '.join(map(repr, policy.signers))}, or the login",
                "give --by as the cell file spells it under `signers`, or leave it out",
            )
    applying = {_as_read(name) for name in request.appliers}
    others = _others(signed, applying)
    if len(others) < policy.signatures:
        may = ", ".join(_others(tuple(policy.signers), applying)) or "no one else"
        yield (
            subject,
            f"{counted(len(others), 'signature')} ({', '.join(others) or 'none'}), not counting "
            "the operator's",
            f"{policy.signatures} of: {may}",
            "have them review the calibration and sign it with `drivegain sign`",
        )


def _as_read(name: str) -> str:
    """Map all spellings that look alike to one:
    case, blanks around, composed or not, wide or narrow.
    """
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    return " ".join(folded.split())


def _others(names: tuple[str, ...], applying: set[str]) -> list[str]:
    """Persons other than the operator, each once however often a name is spelled."""
    persons: dict[str, str] = {}
    for name in names:
        persons.setdefault(_as_read(name), name)
    return [name for person, name in persons.items() if person not in applying]
