"""The gains with their σ: a table, and a picture of gain over nameplate."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from rich.table import Table

from daq.report.document import Figure, Report
from daq.report.picture import BLUE, GREEN, GREY, legend_below, render, single
from daq.report.text import SHOWN_SIGMAS, plain_table, terminal_text
from daq.workflow.geometry_diagnoses import UNEXPLAINED, misfit_text
from daq.workflow.zero_text import DEGREES, MILLIMETRES, zero_off_text
from ident.calibration import (
    Calibration,
    EncoderMisfit,
    Gain,
    GeometryCorrection,
    Parameter,
    PayloadMass,
)
from ident.data.torque_channel import TorqueSlope
from ident.errors import Diagnosis


class OwnTorque(Report):
    """Slope of the drive's own torque over the current."""

    axis: str
    slope: Figure
    std: Figure = None
    ratio: Figure = None
    ratio_std: Figure = None
    readings: int = 0


#: Of the ratio of a drive's own torque to the gain, before a difference is said
CERTAIN_SIGMAS = 3.0


def plot_gains(gains: tuple[Gain, ...], truth: Mapping[str, float] | None = None) -> bytes:
    """Draw how far each identified gain is from its nameplate, with its uncertainty.

    Gains of different axes differ by an order of magnitude and may be negative, so all are shown in
    percent. Return a PNG. `truth` is by axis, for a simulated cell only.
    """
    figure, place = single("Joint drive gains", 3.2)
    positions = np.arange(len(gains))
    change = [gain.change_percent for gain in gains]
    width = [SHOWN_SIGMAS * 100.0 * gain.std / abs(gain.nameplate) for gain in gains]
    place.axhline(0.0, color=GREY, linewidth=1.4, linestyle="--", label="nameplate")
    place.vlines(positions, 0.0, change, color=BLUE, linewidth=5, alpha=0.25)
    place.errorbar(
        positions,
        change,
        yerr=width,
        fmt="o",
        color=BLUE,
        capsize=6,
        markersize=5,
        label=f"identified ± {SHOWN_SIGMAS:g} σ",
    )
    if truth is not None:
        true = [100.0 * (truth[gain.axis] / gain.nameplate - 1.0) for gain in gains]
        # Next to the estimate, so that neither covers the other.
        place.plot(
            positions + 0.14,
            true,
            "D",
            color=GREEN,
            markersize=5,
            label="truth of the simulated cell",
        )
    place.set_xticks(positions, [f"{gain.axis}\n{gain.value:.4g} {gain.unit}" for gain in gains])
    place.set_xlim(-0.6, len(gains) - 0.4)
    place.margins(y=0.15)
    place.set_ylabel("change from the nameplate [%]", fontsize=8)
    legend_below(figure, place)
    return render(figure)


def gain_table(
    gains: tuple[Gain, ...], truth: Mapping[str, float] | None = None, *, title: str | None = None
) -> Table:
    """Table of the gains, a row an axis, with the true ones of a simulated cell;
    fits a terminal of 80 columns.
    """
    true: tuple[str, ...] = ()
    if truth:
        true = ("truth", "error %")
    headings = ("axis", "nameplate", "identified ± σ", "σ %", "change %", *true, "unit")
    table = plain_table(headings, title=title, left=(0, len(headings) - 1))
    for gain in gains:
        std_percent = "-"
        if gain.std:
            std_percent = f"{gain.std_percent:.2f}"
        row = [
            f"{gain.nameplate:.4g}",
            with_deviation(gain.value, gain.std),
            std_percent,
            f"{gain.change_percent:+.1f}",
        ]
        if truth:
            true_gain = truth[gain.axis]
            error_percent = 100.0 * (gain.value / true_gain - 1.0)
            row += [f"{true_gain:.4g}", f"{error_percent:+.2f}"]
        table.add_row(terminal_text(gain.axis), *row, terminal_text(gain.unit))
    return table


def torque_table(slopes: Sequence[TorqueSlope | None], gains: Sequence[Gain]) -> Table:
    """Table of the slopes of the drives' own torque over the current, with the identified gains;
    no fit uses them.

    A ratio shows how far the torque constant in a drive is from the gain: gear losses, or a wrong
    entry.
    """
    headings = ("axis", "slope ± σ", "gain ± σ", "slope/gain", "readings", "unit")
    title = "The drives' own torque against the current, not used in the fit"
    table = plain_table(headings, title=title, left=(0, len(headings) - 1))
    for slope, gain in zip(slopes, gains, strict=True):
        row = ("-", with_deviation(gain.value, gain.std), "-", "0")
        if slope is not None:
            ratio = with_deviation(slope.value / gain.value, _ratio_std(slope, gain))
            row = (with_deviation(slope.value, slope.std), row[1], ratio, str(slope.readings))
        table.add_row(terminal_text(gain.axis), *row, terminal_text(gain.unit))
    return table


def torque_sentences(slopes: Sequence[TorqueSlope | None], gains: Sequence[Gain]) -> Iterator[str]:
    """Say what a slope means that differs from its gain by more than CERTAIN_SIGMAS of their
    ratio.
    """
    far = []
    for slope, gain in zip(slopes, gains, strict=True):
        if slope is None:
            continue
        difference = slope.value / gain.value - 1.0
        if abs(difference) > CERTAIN_SIGMAS * _ratio_std(slope, gain):
            far.append(f"{gain.axis} ({100.0 * difference:+.1f} %)")
    if far:
        yield (
            f"The drive's own torque differs from the gain by more than {CERTAIN_SIGMAS:g} σ on "
            f"{', '.join(far)}: a wrong torque constant was entered in the drive, or the gear has "
            "losses, which the drive does not see."
        )


def own_torques(slopes: Sequence[TorqueSlope | None], gains: Sequence[Gain]) -> list[OwnTorque]:
    """Return the same for `fit --json`; null for an axis whose torque shows no slope."""
    return [_own_torque(slope, gain) for slope, gain in zip(slopes, gains, strict=True)]


def _own_torque(slope: TorqueSlope | None, gain: Gain) -> OwnTorque:
    if slope is None:
        return OwnTorque(axis=gain.axis, slope=None)
    ratio = slope.value / gain.value
    ratio_std = _ratio_std(slope, gain)
    return OwnTorque.of(slope, axis=gain.axis, slope=slope.value, ratio=ratio, ratio_std=ratio_std)


def _ratio_std(slope: TorqueSlope, gain: Gain) -> float:
    """Standard deviation of slope/gain; the two are taken as independent:
    no fit uses the torque.
    """
    return math.hypot(slope.std / gain.value, slope.value * gain.std / gain.value**2)


def partial_note(calibration: Calibration) -> Iterator[str]:
    """Warn of a calibration from a log that is partial or lost frames."""
    partial = [source.name for source in calibration.sources if source.partial]
    if partial:
        yield (
            f"PARTIAL or lossy data ({', '.join(partial)}): not for a controller; `apply` "
            "refuses it."
        )


def diagnosis_texts(diagnoses: Iterable[Diagnosis]) -> tuple[str, ...]:
    """One sentence for each diagnosis, for a view or a page."""
    return tuple(f"CHECK {one.text}." for one in diagnoses)


def warning_texts(calibration: Calibration) -> tuple[str, ...]:
    """Say what to check before the gains are used, for a view or a page."""
    return (*partial_note(calibration), *diagnosis_texts(calibration.diagnoses))


def encoder_text(misfit: EncoderMisfit) -> str:
    """Say how well redundant encoders fit the loops, what would explain their misfit,
    and which geometry was used.
    """
    described = misfit_text(misfit.described, misfit.unit)
    if not misfit.significant:
        return f"fit the loops of the described geometry within {described}"
    left = misfit_text(misfit.left, misfit.unit)
    noise = ""
    if misfit.noise is not None:
        noise = f", where their noise is {misfit_text(misfit.noise, misfit.unit)}"
    if misfit.late_encoders:
        return (
            f"miss the loops by {described}{noise}, explained by {misfit.late_encoders}, which "
            f"leaves {left}; the gains are those of the described geometry"
        )
    if not misfit.corrections:
        return (
            f"miss the loops by {described}{noise}, which {UNEXPLAINED}; all zeros and lengths "
            f"together leave {left}; the gains are those of the described geometry"
        )
    texts = " and ".join(map(_correction_text, misfit.corrections))
    others = ""
    if misfit.alternatives:
        others = f", or by {'; or by '.join(misfit.alternatives)}"
    used = "described"
    if misfit.applied:
        used = "corrected"
    return (
        f"miss the loops by {described}{noise}, explained by {texts}{others}, which leaves {left}; "
        f"the gains are those of the {used} geometry"
    )


def _correction_text(one: GeometryCorrection) -> str:
    """Say how far a number of the description is off, as the diagnoses do."""
    if one.kind == "zero":
        if one.unit == "rad":
            unit = DEGREES
            scale = 180.0 / math.pi
        else:
            unit = MILLIMETRES
            scale = 1e3
        return zero_off_text(one.joint, scale * one.change, scale * one.std, unit)
    std_mm = max(1e3 * one.std, 5e-5)
    if one.kind == "place":
        size = f"{1e3 * one.change:+.4f} ± {std_mm:.4f} mm"
        return (
            f"the place of {one.joint} on the base off by {size} in {one.end} (to be added to it)"
        )
    longer = "shorter"
    if one.change > 0.0:
        longer = "longer"
    size = f"{1e3 * abs(one.change):.4f} ± {std_mm:.4f} mm"
    return f"a {one.kind} from {one.joint} to {one.end} that is {size} {longer} than described"


def mass_texts(influences: Iterable[PayloadMass]) -> Iterator[str]:
    """Say of each payload how a wrong mass changes the gains,
    and what its declared tolerance makes of them.
    """
    for one in influences:
        is_proportional = all(round(gain.percent_per_percent, 2) == 1.0 for gain in one.gains)
        wrong = "every gain is wrong by 1 %"
        at_most = ""
        if not is_proportional:
            listed = ", ".join(
                f"{gain.axis} {gain.percent_per_percent:.2f} %" for gain in one.gains
            )
            wrong = f"the gains are wrong by: {listed}"
            at_most = "at most "
        text = f"if the mass of {one.payload} is wrong by 1 %, {wrong}"
        if one.tolerance_kg > 0.0:
            largest = max(abs(gain.percent_per_percent) for gain in one.gains)
            share_percent = 100.0 * one.tolerance_kg / one.mass_kg * largest
            text += (
                f"; {one.payload} was weighed to {one.mass_kg:g} kg ± {one.tolerance_kg:g} kg, "
                f"which is {at_most}± {share_percent:.2g} % of every gain, not included in σ"
            )
        yield text


MASS_HEADINGS = (
    "payload",
    "axis",
    "gain per kg",
    "gain % per % of mass",
    "σ by the tolerance",
    "unit",
)


def mass_rows(calibration: Calibration) -> Iterator[tuple[str, ...]]:
    """Yield the dependence of each gain on the mass of each payload, under MASS_HEADINGS."""
    units = {gain.axis: gain.unit for gain in calibration.gains}
    for one in calibration.payload_mass:
        for gain in one.gains:
            tolerance_std = "-"
            if one.tolerance_kg > 0.0:
                tolerance_std = f"{gain.tolerance_std:.2g}"
            per_kg = f"{gain.per_kg:.4g}"
            per_percent = f"{gain.percent_per_percent:.3f}"
            unit = units.get(gain.axis, "")
            yield (one.payload, gain.axis, per_kg, per_percent, tolerance_std, unit)


def value_rows(parameters: Iterable[Parameter]) -> list[tuple[str, str, str]]:
    """Return rows of a table of parameters: name, value ± σ, unit."""
    return [
        (sum_text(one.name), with_deviation(one.value, one.std), one.unit) for one in parameters
    ]


_FACTOR = re.compile(r"(?<=[+-] )([0-9.]+(?:e-?[0-9]+)?)\*")
"""Factor of a term in the name of a base parameter, `+ 0.4318*mx2`."""


def sum_text(name: str) -> str:
    """Write the name of a base parameter for readers:
    `Izz1 + Ia1 + 0.4318·mx2` for `Izz1 + 1.0*Ia1 + 0.4318*mx2`.
    """
    return _FACTOR.sub(_factor_text, name)


def _factor_text(found: re.Match[str]) -> str:
    if float(found[1]) == 1.0:
        return ""
    return f"{found[1]}·"


def with_deviation(value: float, std: float, sign: str = "") -> str:
    """Write `33.90 ± 0.14`, to the second digit of σ (ISO Guide 98-3, 7.2.6).

    `32.96 (fixed)` where σ is 0, `-` without a value. A `sign` of "+" is written before positive
    values, too.
    """
    if not math.isfinite(value):
        return "-"
    if std == 0:
        return f"{value:.4g} (fixed)"
    if not math.isfinite(std) or std < 0:
        return f"{value:.4g} ± {std:g}"
    decimals = max(1 - math.floor(math.log10(std)), 0)
    return f"{value:{sign}.{decimals}f} ± {std:.{decimals}f}"
