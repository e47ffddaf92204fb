"""The full parameters of a fit as a table, and what the prior would make of its gains."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from daq.report.text import Sentence, plain_table, terminal_text
from ident.calibration import Calibration
from ident.physical.full_set import FullSet

_ROUNDING = 1e-6  #: Share of its σ below which a value is shown as zero


def full_parameter_view(calibration: Calibration, found: FullSet) -> Iterator[RenderableType]:
    """Every standard parameter with its σ and what it rests on,
    and whether the data agree with the prior.
    """
    yield ""
    yield full_parameter_table(found)
    by_data = sum(one.basis == "data" for one in found.parameters)
    yield Sentence(
        f"{by_data} of {len(found.parameters)} parameters rest on the data; the others are the "
        f"prior's, {found.urdf} with a tolerance of {100.0 * found.tolerance:g} %, as far as the "
        "data leave them free."
    )
    if found.bounded:
        yield Sentence(
            "Some values were moved to those of a robot that can exist; σ is that before the move."
        )
    if found.contradictions:
        yield Sentence(
            f"CHECK the prior: {'; '.join(found.contradictions)}. What is marked `prior` is not to "
            "be trusted: correct the URDF, or give the tolerance that it has.",
            "bold",
        )
    elif found.mass_ratio is not None:
        yield Sentence(
            f"Data and prior agree: by the data, the links together weigh {found.mass_ratio:.2f} ± "
            f"{found.mass_ratio_std:.2f} times what the prior says."
        )
    if found.gains:
        yield gains_with_prior_table(calibration, found)
        yield Sentence("The gains of this calibration are those without the prior.")


def full_parameter_table(found: FullSet) -> Table:
    """A line a parameter: its value ± σ, and whether data or prior decide on it."""
    table = plain_table(
        ("parameter", "value", "± σ", "unit", "by", "prior", "± σ"),
        title="Full parameters",
        left=(0, 3, 4),
    )
    for one in found.parameters:
        prior = "-"
        if one.prior is not None:
            prior = f"{one.prior:.4g}"
        prior_std = "-"
        if one.prior_std is not None:
            prior_std = f"{one.prior_std:.2g}"
        is_rounding = abs(one.value) < _ROUNDING * one.std
        value = one.value
        if is_rounding:
            value = 0.0
        table.add_row(
            terminal_text(one.name),
            f"{value:.4g}",
            f"{one.std:.2g}",
            one.unit,
            one.basis,
            prior,
            prior_std,
        )
    return table


def gains_with_prior_table(calibration: Calibration, found: FullSet) -> Table:
    """Gains without and with the prior, and the shift in σ."""
    table = plain_table(
        ("axis", "gain", "± σ", "with the prior", "± σ", "shift σ"), title="Gains and the prior"
    )
    for gain, other in zip(calibration.gains, found.gains, strict=True):
        shift = (other.value - gain.value) / gain.std
        table.add_row(
            terminal_text(gain.axis),
            f"{gain.value:.4g}",
            f"{gain.std:.2g}",
            f"{other.value:.4g}",
            f"{other.std:.2g}",
            f"{shift:+.2f}",
        )
    return table
