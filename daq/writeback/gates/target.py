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

#: Largest relative difference between two texts of one number
_SAME_NUMBER_TOLERANCE = 1e-9
_CHECK_CURRENT_SCALE = (
    "check scale and amplitude (RMS or peak) of the current in the drive profile, and the "
    "payload's mass"
)


def finite_gains(context: GateContext) -> Iterator[GateFinding]:
    """Require finite numbers: gain (not zero), σ (not negative), current gain, nameplate."""
    for change in context.edit.changes:
        if not _is_finite(change):
            found = f"gain {change.new:g} ± {change.std:g}, {_compared_text(change)}"
            yield (
                change.axis,
                found,
                "finite numbers, not zero",
                "fit the logs again",
            )


def identified(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a gain that the fit held fixed (σ = 0)."""
    for change in _finite_changes(context):
        if change.std == 0:
            yield (
                change.axis,
                "a gain that the fit held fixed (σ = 0)",
                "an identified one",
                "fit with a loaded run and free gains",
            )


def uncertainty(context: GateContext) -> Iterator[GateFinding]:
    """Bound σ, relative to the gain."""
    largest_percent = context.policy.max_std_percent
    remedy = "record longer or more exciting moves, or a heavier payload"
    if not context.calibration.effects:
        remedy = (
            f"look for what the model lacks with `drivegain residual`, as it is in σ; or {remedy}"
        )
    for change in _finite_changes(context):
        if not change.std_percent <= largest_percent:
            percent = format_at_limit(change.std_percent, largest_percent, 2)
            yield (
                change.axis,
                f"σ {percent} %",
                f"at most {largest_percent:g} %",
                remedy,
            )


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
                f"gain {change.new:g}, {_compared_text(change)}",
                "the same sign",
                "check the directions of encoder and current in the cell configuration",
            )


def change_bound(context: GateContext) -> Iterator[GateFinding]:
    """Bound the change from the current gain."""
    largest_percent = context.policy.max_change_percent
    for change in filter(_keeps_sign, _finite_changes(context)):
        if not abs(change.change_percent) <= largest_percent:
            percent = format_at_limit(change.change_percent, largest_percent, 1, "+f")
            yield (
                change.axis,
                f"{percent} % from the current gain",
                f"at most ±{largest_percent:g} %",
                _CHECK_CURRENT_SCALE,
            )
        largest = context.policy.max_change.get(change.axis)
        difference = change.new - change.compared_gain
        if largest is not None and not abs(difference) <= largest:
            number = format_at_limit(difference, largest, 4, "+g")
            yield (
                change.axis,
                f"{number} {change.unit} from the current gain",
                f"at most ±{largest:g} {change.unit}",
                _CHECK_CURRENT_SCALE,
            )


def nameplate_bound(context: GateContext) -> Iterator[GateFinding]:
    """Bound the change from the nameplate."""
    largest_percent = context.policy.max_nameplate_percent
    for change in filter(_keeps_sign, _finite_changes(context)):
        if not abs(change.nameplate_percent) <= largest_percent:
            percent = format_at_limit(change.nameplate_percent, largest_percent, 1, "+f")
            yield (
                change.axis,
                f"{percent} % from the nameplate",
                f"at most ±{largest_percent:g} %",
                "check the drive profile, the nameplate and the payload's mass",
            )


def same_nameplate(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a comparison with another nameplate than the cell's."""
    for gain, axis in _axes_of_cell(context):
        if not math.isfinite(gain.nameplate):
            continue  # `finite_gains` refuses it
        is_same = math.isclose(gain.nameplate, axis.nameplate_gain, rel_tol=_SAME_NUMBER_TOLERANCE)
        if not is_same:
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
            yield (
                gain.axis,
                f"a gain in {gain.unit!r}",
                f"{axis.gain_unit!r}, as the cell file has it",
                "fit the logs again with --cell",
            )


def _is_finite(change: GainChange) -> bool:
    """Return whether `finite_gains` accepts a change."""
    numbers = (change.new, change.std, change.compared_gain, change.nameplate_gain)
    are_finite = all(map(math.isfinite, numbers))
    return are_finite and change.new != 0 and change.std >= 0


def _finite_changes(context: GateContext) -> Iterator[GainChange]:
    """Changes that `finite_gains` accepts; it refuses the others, and one refusal is enough."""
    return filter(_is_finite, context.edit.changes)


def _keeps_sign(change: GainChange) -> bool:
    """Return whether the new gain has the sign of the compared gain and of the nameplate."""
    has_sign_of_compared = change.new * change.compared_gain > 0
    has_sign_of_nameplate = change.new * change.nameplate_gain > 0
    return has_sign_of_compared and has_sign_of_nameplate


def _compared_text(change: GainChange) -> str:
    """Name the compared gain and the nameplate, with their numbers; once if they are the same."""
    nameplate = f"nameplate {change.nameplate_gain:g}"
    if change.compared_with is GainOrigin.NAMEPLATE:
        return nameplate
    return f"{change.compared_with.value} {change.compared_gain:g}, {nameplate}"


def _axes_of_cell(context: GateContext) -> Iterator[tuple[Gain, CellAxis]]:
    """Yield each gain with its axis in the cell; nothing where there is no cell."""
    if context.cell is None:
        return
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
        reviewed_sha256 = None
        reviewed_after = None
    else:
        # A value that is no digest is an error even where nothing will be written.
        reviewed_sha256, reviewed_after = parse_base(base, edit.before or b"")
    if edit.keeps_all:
        return
    planned_after = short_digest(edit.after)
    if reviewed_sha256 is None:
        yield from edit.unexpected
    elif reviewed_sha256 != edit.base_sha256:
        yield (
            edit.subject,
            f"content {edit.base_sha256[:12]}…",
            f"{reviewed_sha256[:12]}…, as --base says",
            "the content has changed since that review: take a new dry run, without --base",
        )
    elif reviewed_after not in {None, planned_after}:
        yield (
            edit.subject,
            f"a change to {planned_after}…",
            f"to {reviewed_after}…, as --base says",
            "the calibration, the keys or the factors have changed since the dry run: take "
            "a new one",
        )


def signature(context: GateContext) -> Iterator[GateFinding]:
    """Require signatures of others than the operator; `--by` must be a signer or the login.

    Names are compared without case and blanks, and however they are encoded (NFKC). The operator's
    name must be a signer's, or the login: otherwise a name that only looks like their own would
    count as another person.

    Raises:
        ConfigurationInconsistent: a public key of the policy is none.
    """
    policy = context.policy
    request = context.request
    if not policy.signatures:
        return
    subject = "calibration"
    signed: tuple[str, ...] = ()
    if request.file is not None:
        subject = str(request.file)
        try:
            signed = signers_of(request.file, policy.signers, request.signed)
        except SignatureInvalid as error:
            yield error.subject, error.found, error.expected, error.remedy
            return
    *given_names, login = request.appliers or ("",)
    allowed_operators = {_normalized(name) for name in (*policy.signers, login)}
    for name in given_names:
        if not name or _normalized(name) not in allowed_operators:
            signer_names = ", ".join(map(repr, policy.signers))
            yield (
                "operator",
                ascii(name),
                f"one of {signer_names}, or the login",
                "give --by as the cell file spells it under `signers`, or leave it out",
            )
    operator_names = {_normalized(name) for name in request.appliers}
    counting = _without_operator(signed, operator_names)
    if len(counting) < policy.signatures:
        count_text = counted(len(counting), "signature")
        found_names = ", ".join(counting) or "none"
        possible = _without_operator(tuple(policy.signers), operator_names)
        possible_names = ", ".join(possible) or "no one else"
        yield (
            subject,
            f"{count_text} ({found_names}), not counting the operator's",
            f"{policy.signatures} of: {possible_names}",
            "have them review the calibration and sign it with `drivegain sign`",
        )


def _normalized(name: str) -> str:
    """Return the common form of all texts of a name that look the same: they differ in case, in
    blanks, in wide or narrow characters, and in how accents are encoded.
    """
    # Case folding may make characters that NFKC changes again, so it is applied before and after.
    composed = unicodedata.normalize("NFKC", name)
    folded = unicodedata.normalize("NFKC", composed.casefold())
    return " ".join(folded.split())


def _without_operator(names: tuple[str, ...], operator_names: set[str]) -> list[str]:
    """Return the persons other than the operator, each once.

    Args:
        names: of signers; several may be texts of one person's name.
        operator_names: of the operator, normalized.
    """
    persons: dict[str, str] = {}
    for name in names:
        persons.setdefault(_normalized(name), name)
    for operator_name in operator_names:
        persons.pop(operator_name, None)
    return list(persons.values())
