"""A body weighed on the flange, and contacts:
tables, documents and the picture of external torques.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from daq.config.cell import Cell, robot_of
from daq.files import replace_file
from daq.report.document import Figure, Report
from daq.report.fit import Errors
from daq.report.gains import with_deviation
from daq.report.picture import BLACK, ORANGE, SKY, legend_below, panels, render, unformatted
from daq.report.text import known_text, plain_table, terminal_text
from daq.workflow.fit import DOUBTFUL_PERCENT
from daq.workflow.weigh import Weighed
from ident.arrays import FloatArray
from ident.contact import ExternalTorque
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, pseudo_inertia
from ident.model.robot import Place
from ident.model.urdf import read_urdf
from ident.weighing import KNOWN, WeighedBody


class WeighedValue(Report):
    """A number and its σ."""

    value: Figure
    std: Figure


class WeighedValues(Report):
    """Numbers and their σ."""

    value: list[Figure]
    std: list[Figure]


class AddedMoves(Report):
    """Moves that would show a parameter."""

    words: str
    seconds: float
    std: Figure


class WeighedParameter(Report):
    """One of the ten parameters of a body."""

    name: str
    unit: str
    value: Figure
    std: Figure
    std_of_moves: Figure
    identifiable: bool
    add: AddedMoves | None


class WeighReport(Report):
    """`weigh`."""

    cell: str
    logs: list[str]
    bare: list[str]
    part_of_the_fit: list[str]
    declared_kg: Figure
    mass_kg: WeighedValue
    mass_std_of_reference_kg: Figure
    """share of σ of the mass that is the tolerance of the payload masses of the calibration;
    it is in `std`
    """
    centre_m: WeighedValues
    centre_in_platform_m: WeighedValues | None
    inertia_about_centre_kg_m2: WeighedValues
    parameters: list[WeighedParameter]
    relative_error_percent: Errors
    moves: int
    complete: bool


class ContactAxis(Report):
    """Band and threshold of one axis; medians over the motion in `unit`."""

    axis: str
    unit: str
    scale: list[Figure]
    band_over_scale: Figure
    threshold_over_scale: Figure
    correlation_s: Figure
    quiet_s: Figure
    band: Figure
    threshold: Figure
    largest: Figure


class ContactEntry(Report):
    """A stretch beyond the threshold."""

    axis: str
    start_s: float
    end_s: float
    peak: float
    peak_over_threshold: float


class NotJudged(Report):
    """An axis that cannot show a contact."""

    axis: str
    reason: str


class ContactReport(Report):
    """`contact`."""

    cell: str
    log: str
    band_from_this_log: bool
    stretches_left_out: int
    alarms_per_hour: float
    axes: list[ContactAxis]
    contacts: list[ContactEntry]
    not_judged: list[NotJudged]
    picture: str | None


LISTED = 20  #: Contacts shown in a terminal; `--json` has all
NOISE_ROWS = 4.0
"""Longest correlation of noise, in rows.

The simulated cell has 1; an undeclared plate of 1.7 kg makes it 6 to 90.
"""


def weighed_view(found: Weighed) -> Iterator[RenderableType]:
    """Mass, centre and inertia, the ten parameters, and doubts."""
    body = found.body
    carrier = _carrier(found.cell)
    nothing = _shows_nothing(body)
    turns = not np.isnan(body.values[:-1]).all()
    shown = turns and not nothing
    if nothing:
        yield Text("No body shows: the mass is within two σ of nothing.", style="bold")
    table = plain_table(("", "value ± σ", "unit"), title=f"Body on the {carrier}", left=(0, 2))
    table.add_row("mass", with_deviation(body.mass_kg, body.mass_std_kg), "kg")
    if shown:
        _add_centre_and_inertia(table, found)
    yield table
    if shown:
        platform = _platform(found.cell)
        but = ""
        if platform is not None:
            but = f"; `centre … in {platform[0]}` is in the link's own frame"
        yield f"In the frame of {carrier_text(found.cell)}{but}."
    elif not turns:
        yield f"The {carrier} does not turn in these moves: centre and inertia cannot be seen."
    if found.declared_kg is not None:
        difference_percent = 100.0 * (body.mass_kg / found.declared_kg - 1.0)
        yield f"The logs declare {found.declared_kg:g} kg: {difference_percent:+.2f} %."
    yield _basis_text(found)
    if shown:
        headings = ("parameter", "value ± σ", "unit", "identifiable")
        ten = plain_table(headings, title="The ten about the joint's frame", left=(0, 2, 3))
        _add_parameters(ten, body)
        yield ""
        yield ten
        if any(np.isfinite(body.std) & ~body.identifiable):
            yield (
                f"Not identifiable with a σ: it is more than {100 * KNOWN:.0f} % of the value, and "
                "2 σ is more than a steel cube of the least mass (m − 2 σ) has."
            )
    if not nothing:
        # Below the table: in its rows they would push σ and unit off a terminal of 80 columns.
        for one in found.help:
            yield f"{one.name}: add {one.seconds:.0f} s of {one.words} (σ {one.std:.2g})"
    yield from (Text(doubt, style="bold") for doubt in _doubts(found))


def _carrier(cell: Cell) -> str:
    """Part of the robot that carries the body."""
    if cell.chain is None and cell.platform is None:
        return "flange"
    return "platform"


def _basis_text(found: Weighed) -> str:
    """Return what the body was found on, and which errors its σ includes."""
    body = found.body
    errors = "moves and gains"
    if body.complete:
        errors = "moves, gains, robot and effects"
    if body.mass_reference_std_kg > 0.0:
        errors += " and with the tolerance of the calibration's payload mass"
    how = "on the robot of the calibration"
    if found.bare:
        how = "robot and body together, with runs without load"
    left = f"it leaves {body.error.total:.3g} %"
    return f"Found {how}; σ from {body.moves} moves, with the errors of {errors}; {left}."


def _add_parameters(table: Table, body: WeighedBody) -> None:
    rows = zip(LINK_PARAMETERS, LINK_UNITS, body.values, body.std, body.identifiable, strict=True)
    for name, unit, value, std, identifiable in rows:
        known = "no"
        if identifiable:
            known = "yes"
        table.add_row(name, with_deviation(value, std), unit, known)


def _smallest_pseudo_inertia(body: WeighedBody) -> float:
    """Smallest eigenvalue of the pseudo-inertia; negative where no solid body has this inertia."""
    eigenvalues = np.linalg.eigvalsh(pseudo_inertia(body.values))
    return float(eigenvalues[0])


def _shows_nothing(body: WeighedBody) -> bool:
    return body.mass_kg < 2.0 * body.mass_std_kg


def _add_centre_and_inertia(table: Table, found: Weighed) -> None:
    body = found.body
    centres = {"": body.centre_m}
    platform = _platform(found.cell)
    if platform is not None:
        link, frame = platform
        centres[f" in {link}"] = body.centre_in(frame)
    for where, (centre_m, std_m) in centres.items():
        for name, value, std in zip("xyz", 1000.0 * centre_m, 1000.0 * std_m, strict=True):
            table.add_row(terminal_text(f"centre {name}{where}"), with_deviation(value, std), "mm")
    for name, value, std in zip(LINK_PARAMETERS[:6], *body.inertia_kg_m2, strict=True):
        table.add_row(f"{name} about the centre", with_deviation(value, std), "kg m²")


def _doubts(found: Weighed) -> Iterator[str]:
    body = found.body
    if not body.complete:
        yield (
            "The calibration has no covariance: σ lacks the errors of its robot; fit its "
            "logs again."
        )
    if body.error.total > DOUBTFUL_PERCENT:
        yield (
            f"The logs contradict the calibration: {body.error.total:.3g} % of the torque is left. "
            "Is it the same robot, and one body mounted one way?"
        )
    is_known = not _shows_nothing(body) and not np.isnan(body.values).any()
    if is_known and _smallest_pseudo_inertia(body) < 0.0:
        yield "No solid body has exactly this inertia; use it within its σ."


def carrier_text(cell: Cell) -> str:
    """Name the joint whose frame the parameters of a payload are in,
    and where the platform's link is in it.
    """
    if cell.chain is None and cell.platform is None:
        return "the last joint"
    robot = robot_of(cell)
    name = f"the joint {robot.joints[robot.carrier].name}"
    if cell.platform is None:
        return name
    x, y, z = 1000.0 * read_urdf(cell.urdf).links[cell.platform].translation_m
    return f"{name}, in which the link {cell.platform} is at ({x:.4g}, {y:.4g}, {z:.4g}) mm"


def _platform(cell: Cell) -> tuple[str, Place] | None:
    """Platform's link and its frame in that of the joint that carries it;
    None where it is that joint's frame.
    """
    if cell.platform is None:
        return None
    frame = read_urdf(cell.urdf).links[cell.platform]
    same = np.allclose(frame.rotation, np.eye(3)) and not frame.translation_m.any()
    if same:
        return None
    return (cell.platform, frame)


def weigh_report(found: Weighed) -> WeighReport:
    """Return a body: mass, centre, inertia, and its ten parameters with the moves that would show
    them.
    """
    body = found.body
    platform = _platform(found.cell)
    centre_in_platform_m = None
    if platform is not None:
        _, frame = platform
        centre_in_platform_m = _weighed_values(*body.centre_in(frame))
    return WeighReport.of(
        found,
        body,
        cell=found.cell.name,
        part_of_the_fit=found.fitted,
        mass_kg=WeighedValue(value=body.mass_kg, std=body.mass_std_kg),
        mass_std_of_reference_kg=body.mass_reference_std_kg,
        centre_m=_weighed_values(*body.centre_m),
        centre_in_platform_m=centre_in_platform_m,
        inertia_about_centre_kg_m2=_weighed_values(*body.inertia_kg_m2),
        parameters=_weighed_parameters(found),
        relative_error_percent=body.error,
    )


def _weighed_values(value: FloatArray, std: FloatArray) -> WeighedValues:
    return WeighedValues.of(value=value, std=std)


def _weighed_parameters(found: Weighed) -> list[WeighedParameter]:
    body = found.body
    moves_std = np.sqrt(np.diag(body.moves_covariance))
    moves = {one.name: one for one in found.help}
    parameters = []
    for index, (name, unit) in enumerate(zip(LINK_PARAMETERS, LINK_UNITS, strict=True)):
        parameter = WeighedParameter.of(
            name=name,
            unit=unit,
            value=body.values[index],
            std=body.std[index],
            std_of_moves=moves_std[index],
            identifiable=body.identifiable[index],
            add=moves.get(name),
        )
        parameters.append(parameter)
    return parameters


def contact_view(found: ExternalTorque, cell: Cell) -> Iterator[RenderableType]:
    """Band and threshold of each axis, and the contacts."""
    headings = ("axis", "quiet s", "band ±", "threshold", "largest", "unit")
    table = plain_table(headings, title="External torque (medians over the motion)", left=(0, 5))
    for shown, quiet_s in zip(_contact_axes(found, cell), found.band.quiet_s, strict=True):
        band = known_text(shown.band, ".3g")
        threshold = known_text(shown.threshold, ".3g")
        largest = known_text(shown.largest, ".3g")
        table.add_row(shown.axis, f"{quiet_s:.0f}", band, threshold, largest, shown.unit)
    yield table
    source = "the quiet logs"
    if found.from_itself:
        source = "this log"
    if found.from_itself and found.left_out:
        stretches = "1 stretch that is"
        if found.left_out != 1:
            stretches = f"{found.left_out} stretches that are"
        source = f"this log less {stretches} far out"
    yield (
        f"Band (95 %) and threshold from {source}; less than {found.band.alarms_per_hour:g} false "
        "alarm in an hour of motion like that, all axes together, on average and from five quiet "
        "minutes on. Standstill is not judged."
    )
    contacts = found.contacts
    missing = not_judged(found, cell)
    yield ""
    if not contacts and len(missing) < len(cell.axes):
        judged = ", ".join(name for name in cell.axis_names if name not in missing)
        yield f"No contact on {judged}." if missing else "No contact."
    for name, reason in missing.items():
        yield Text(f"{name} not judged: {reason}.", style="bold")
    if not contacts:
        return
    listed = plain_table(
        ("axis", "from s", "to s", "peak", "unit", "× threshold"), title="Contacts", left=(0, 4)
    )
    for one in contacts[:LISTED]:
        axis = cell.axes[one.axis]
        listed.add_row(
            axis.name,
            f"{one.start_s:.2f}",
            f"{one.end_s:.2f}",
            f"{one.peak_nm:+.3g}",
            axis.unit.force,
            f"{one.peak_over_threshold:.2f}",
        )
    yield listed
    if len(contacts) > LISTED:
        yield f"… and {len(contacts) - LISTED} more; --json lists all."


def not_judged(found: ExternalTorque, cell: Cell) -> dict[str, str]:
    """Say why an axis cannot show a contact, by its name;
    only axes without a threshold or without motion.
    """
    reasons = {}
    band = found.band
    row_s = float(np.median(np.diff(found.time_s)))
    for axis, level, use, quiet_s, correlation_s in zip(
        cell.axis_names, band.threshold, found.use, band.quiet_s, band.correlation_s, strict=True
    ):
        if not use.any():
            reasons[axis] = "it does not move in this log"
        elif np.isfinite(level):
            continue
        elif correlation_s <= NOISE_ROWS * row_s:
            reasons[axis] = (
                f"{quiet_s:.0f} s of quiet motion have too few separate peaks; record longer"
            )
        else:
            reasons[axis] = (
                f"its residual stays on one side for {correlation_s:.2g} s at a time, with too few "
                "separate peaks; a temperature may be missing, or a body undeclared"
            )
    return reasons


def contact_report(
    found: ExternalTorque, cell: Cell, log: Path, picture: Path | None
) -> ContactReport:
    """Return band and threshold of each axis, and the contacts."""
    contacts = []
    for contact in found.contacts:
        axis = cell.axis_names[contact.axis]
        contacts.append(ContactEntry.of(contact, axis=axis, peak=contact.peak_nm))
    missing = []
    for axis, reason in not_judged(found, cell).items():
        missing.append(NotJudged(axis=axis, reason=reason))
    return ContactReport.of(
        cell=cell.name,
        log=log,
        band_from_this_log=found.from_itself,
        stretches_left_out=found.left_out,
        alarms_per_hour=found.band.alarms_per_hour,
        axes=_contact_axes(found, cell),
        contacts=contacts,
        not_judged=missing,
        picture=picture,
    )


def _contact_axes(found: ExternalTorque, cell: Cell) -> list[ContactAxis]:
    learned = found.band
    axes = []
    for index, axis in enumerate(cell.axes):
        use = found.use[index]
        # None of these is known of an axis that did not move.
        figures = dict.fromkeys(("band", "threshold", "largest"))
        if use.any():
            figures = {
                "band": np.median(found.band_nm[index, use]),
                "threshold": np.median(found.threshold_nm[index, use]),
                "largest": np.abs(found.torque_nm[index, use]).max(),
            }
        contact_axis = ContactAxis.of(
            axis=axis.name,
            unit=axis.unit.force,
            scale=learned.scale[index],
            band_over_scale=learned.factor[index],
            threshold_over_scale=learned.threshold[index],
            correlation_s=learned.correlation_s[index],
            quiet_s=learned.quiet_s[index],
            **figures,
        )
        axes.append(contact_axis)
    return axes


def draw_contact(found: ExternalTorque, cell: Cell, log: Path, folder: Path) -> Path:
    """Draw the external torque of each axis with band and threshold; return the picture.

    Raises:
        OSError: from the file system.
    """
    title = f"{unformatted(log.stem)}: external torque of {unformatted(cell.name)}"
    figure, places = panels(len(cell.axes), 2, title)
    for index, (axis, place) in enumerate(zip(cell.axes, places, strict=True)):
        use = found.use[index]
        torque = np.where(use, found.torque_nm[index], np.nan)
        band = np.where(use, found.band_nm[index], np.nan)
        threshold = np.where(use, found.threshold_nm[index], np.nan)
        place.fill_between(
            found.time_s, -band, band, color=SKY, alpha=0.5, linewidth=0.0, label="band, 95 %"
        )
        for sign, label in ((1.0, "threshold"), (-1.0, None)):
            place.plot(found.time_s, sign * threshold, color=ORANGE, linewidth=0.9, label=label)
        place.plot(found.time_s, torque, color=BLACK, linewidth=0.9, label="external torque")
        place.set_title(unformatted(axis.name), fontsize=9, loc="left")
        place.set_ylabel(f"[{axis.unit.force}]", fontsize=8)
        if index >= len(cell.axes) - 2:
            place.set_xlabel("time [s]", fontsize=8)
    legend_below(figure, places[0])
    path = folder / f"{log.stem}-contact.png"
    replace_file(path, render(figure))
    return path
