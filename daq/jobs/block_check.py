"""Look at a block right after its recording:
a mistake that it shows costs one block then, and not the session.

The body on the flange is weighed with the nameplate gains (`ident.weighing`), against the blocks
before. These gains may be off by a quarter; a body that was forgotten is off by all of its mass. In
a wrong geometry the weighing tells nothing, so gravity and the positions are judged before a body
is blamed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, CellAxis, WeighedPayload, model_of
from daq.documents.session_state import Block
from daq.errors import DataError
from daq.log.conversion import load_run
from daq.workflow.diagnoses import Recordings, turned_geometry
from ident.calibration import Calibration, Gain
from ident.errors import Diagnosis, IdentificationError
from ident.estimators.estimate import RelativeError
from ident.weighing import weigh

LEAST_SHARE = 0.25  #: Of the payload's mass; a smaller difference is that of the nameplate gains
LEAST_SIGMAS = 5.0  #: Of the difference
COARSE_SHARE = 0.5  #: The same of the payload's mass: a coarser weighing tells nothing
MOMENT = slice(6, 9)  #: m x, m y and m z among the ten parameters of a body
LARGEST_SHIFT_M = 0.02  #: Of the centre of mass between two blocks; a turned body moves it by more
#: Weighed over declared mass: outside, it is another body, or a gain is far off
SAME_BODY = (0.5, 2.0)


@dataclass(frozen=True, slots=True)
class BlockFacts:
    """What the log of a block shows by itself, and against earlier blocks."""

    unreadable: str = ""  #: why no fit can use it; empty where one can
    #: share of samples with an active current limit, by axis
    saturated_percent: tuple[float, ...] = ()
    #: mass on the flange beyond that in the earlier blocks; None where it does not show
    added_kg: float | None = None
    added_std_kg: float = 0.0  #: its σ, the gains taken as exact
    #: size of the first moment of mass that comes with it; 0 where it does not show
    added_moment_kg_m: float = 0.0
    added_moment_std_kg_m: float = 0.0  #: its σ likewise


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake in a block."""

    blocks: tuple[str, ...]  #: to record again, the last ones of the session
    text: str  #: what was found and what to do, in a sentence or two
    is_of_body: bool = True  #: whether another body on the flange than declared is blamed


def look_at_block(cell: Cell, log: Path, earlier: Sequence[Path]) -> BlockFacts:
    """Read the log of a block, and weigh what it carries beyond earlier blocks.

    Args:
        cell: of the session.
        log: of the block.
        earlier: logs that all carry the same; without any that can be read, nothing is weighed.
    """
    try:
        run, _ = load_run(log, cell)
    except DataError as error:
        return BlockFacts(unreadable=f"{error.found}: {error.remedy}")
    saturated: tuple[float, ...] = ()
    if run.recording is not None:
        saturated = run.recording.saturated_percent
    others = []
    for earlier_log in earlier:
        # An earlier log that cannot be read is no mistake of this block: it is left out.
        with contextlib.suppress(DataError):
            other, _ = load_run(earlier_log, cell)
            others.append(other)
    if not others:
        return BlockFacts(saturated_percent=saturated)
    try:
        body = weigh(
            _with_nameplate_gains(cell), model_of(cell), (run,), cell.conditioning, bare=others
        )
    except IdentificationError:
        return BlockFacts(saturated_percent=saturated)
    if not np.isfinite(body.mass_kg):
        return BlockFacts(saturated_percent=saturated)
    moment_kg_m = np.nan_to_num(body.values[MOMENT])
    moment_std_kg_m = np.nan_to_num(body.std[MOMENT])
    moment_norm_kg_m = float(np.linalg.norm(moment_kg_m))
    moment_std_norm_kg_m = float(np.linalg.norm(moment_std_kg_m))
    return BlockFacts(
        saturated_percent=saturated,
        added_kg=body.mass_kg,
        added_std_kg=body.mass_std_kg,
        added_moment_kg_m=moment_norm_kg_m,
        added_moment_std_kg_m=moment_std_norm_kg_m,
    )


def look_at_geometry(cell: Cell, logs: Sequence[Path]) -> Diagnosis | None:
    """Return what is wrong with gravity, a zero or the sense of a position by these logs,
    as a fit of them says it.

    None where the description explains them as well as any other, and where they tell nothing.
    """
    recordings = Recordings(
        tuple(logs), lambda log: load_run(log, cell), gains_fixed=False, described=cell
    )
    try:
        return turned_geometry(recordings, (), None)
    except (DataError, IdentificationError):
        return None


def compared_with(blocks: Sequence[Block]) -> tuple[Block, ...]:
    """Return the earlier blocks that the last one is weighed against.

    They have the same body; without such blocks, a loaded block is weighed against bare ones, and a
    bare block that is recorded again against loaded ones.
    """
    *earlier, last = blocks
    same = tuple(block for block in earlier if block.payload == last.payload)
    return same or tuple(earlier)


def mistake_in(
    cell: Cell,
    payload: str,
    blocks: Sequence[Block],
    facts: BlockFacts,
    repeated: Sequence[str] = (),
) -> Mistake | None:
    """Judge the last block.

    Args:
        cell: of the session.
        payload: name of the body of the loaded blocks; its mass is that of the cell file until it
            was weighed.
        blocks: of the session, in the order of their recording.
        facts: of the last block, besides `compared_with` of these blocks.
        repeated: names of the blocks that were recorded again because of a mistake.
    """
    last = blocks[-1]
    if facts.unreadable:
        text = f"No fit can use this block: {facts.unreadable}."
        return Mistake((last.name,), text, is_of_body=False)
    limited = _limited(cell, facts)
    if limited:
        return Mistake((last.name,), limited, is_of_body=False)
    body = next(one for one in cell.payloads if one.name == payload)
    weighed_kg = [block.mass_kg for block in blocks if block.payload is not None and block.mass_kg]
    if weighed_kg:
        body = replace(body, mass_kg=weighed_kg[-1])
    return _mistake_of_body(blocks, body, facts, is_again=last.name in repeated)


def _mistake_of_body(
    blocks: Sequence[Block], body: WeighedPayload, facts: BlockFacts, *, is_again: bool
) -> Mistake | None:
    """Judge the body on the flange in the last block by its weight beyond `compared_with`."""
    added_kg = facts.added_kg
    noise_kg = LEAST_SIGMAS * facts.added_std_kg
    if added_kg is None or noise_kg > COARSE_SHARE * body.mass_kg:
        return None
    last = blocks[-1]
    least_kg = max(LEAST_SHARE * body.mass_kg, noise_kg)
    has_same = compared_with(blocks)[-1].payload == last.payload
    if has_same and last.payload is None:
        return _compare_bare_with_bare(blocks, body, added_kg, least_kg)
    if has_same:
        return _compare_loaded_with_loaded(last, body, added_kg, least_kg) or _turned(
            last, body.mass_kg, facts
        )
    if last.payload is None:
        return _compare_bare_with_loaded(last, body, added_kg, least_kg)
    return _compare_loaded_with_bare(blocks, body, added_kg, least_kg, is_again=is_again)


def _limited(cell: Cell, facts: BlockFacts) -> str:
    """Name the axis that was at its current limit for longer than a write takes;
    empty where none was.
    """
    most_percent = cell.apply.max_saturated_percent
    for axis, percent in zip(cell.axis_names, facts.saturated_percent, strict=False):
        if percent > most_percent:
            return (
                f"{axis} was at its current limit for {percent:.1f} % of this block, and a write "
                f"takes at most {most_percent:g} %. Press Ctrl-C, lower the acceleration limit of "
                f"{axis} in the cell file, and start again."
            )
    return ""


def _compare_bare_with_bare(
    blocks: Sequence[Block], body: WeighedPayload, added_kg: float, least_kg: float
) -> Mistake | None:
    """Judge a bare block against earlier bare ones."""
    if abs(added_kg) <= least_kg:
        return None
    last = blocks[-1]
    if added_kg > 0.0:
        name = body.name.upper()
        text = (
            f"A body of about {added_kg:.2g} kg was on the flange, and this block has none: "
            f"take {name} off."
        )
        return Mistake((last.name,), text)
    earlier = tuple(block.name for block in compared_with(blocks))
    text = (
        f"The flange carried about {-added_kg:.2g} kg less than in {' and '.join(earlier)}, where "
        "it should be bare, too. All of these are recorded again, without anything on the flange."
    )
    return Mistake((*earlier, last.name), text)


def _compare_loaded_with_loaded(
    last: Block, body: WeighedPayload, added_kg: float, least_kg: float
) -> Mistake | None:
    """Judge a loaded block against earlier loaded ones."""
    if abs(added_kg) <= least_kg:
        return None
    change = f"{abs(added_kg):.2g} kg {'more' if added_kg > 0.0 else 'less'}"
    name = body.name.upper()
    text = (
        f"The flange carried about {change} than in the loaded blocks before: mount {name}, as "
        "it was then."
    )
    return Mistake((last.name,), text)


def _turned(last: Block, mass_kg: float, facts: BlockFacts) -> Mistake | None:
    """Judge whether the right body is mounted as it was in the blocks before."""
    if last.payload is None:
        return None
    shift_m = facts.added_moment_kg_m / mass_kg
    noise_m = LEAST_SIGMAS * facts.added_moment_std_kg_m / mass_kg
    if shift_m <= max(LARGEST_SHIFT_M, noise_m):
        return None
    text = (
        f"The centre of mass of {last.payload.upper()} was about {1000.0 * shift_m:.0f} mm away "
        "from where it was in the loaded blocks before: mount it as it was then, not turned."
    )
    return Mistake((last.name,), text)


def _compare_bare_with_loaded(
    last: Block, body: WeighedPayload, added_kg: float, least_kg: float
) -> Mistake | None:
    """Judge a bare block against loaded ones, as the first bare block that is recorded again."""
    if abs(added_kg) > least_kg:
        return None
    text = (
        f"The flange carried the same as in the loaded blocks before: take {body.name.upper()} off."
    )
    return Mistake((last.name,), text)


def _compare_loaded_with_bare(
    blocks: Sequence[Block],
    body: WeighedPayload,
    added_kg: float,
    least_kg: float,
    *,
    is_again: bool,
) -> Mistake | None:
    """Judge the first loaded block against the bare ones.

    Where it carries the same, the body was forgotten, as a rule: one block tells. Only where it
    carries the same once more, the body was there in the bare ones.
    """
    last = blocks[-1]
    name = body.name.upper()
    everything = tuple(block.name for block in blocks)
    bare = " and ".join(everything[:-1])
    again = (
        "All of these are recorded again, those before the last one without anything on the flange."
    )
    is_same = abs(added_kg) <= least_kg
    if is_same and not is_again:
        return Mistake(
            (last.name,), f"The flange carried the same as in {bare}: {name} was missing. Mount it."
        )
    if is_same:
        text = (
            f"The flange carried the same as in {bare} once more: if {name} is mounted now, it was "
            f"there before, too. {again}"
        )
        return Mistake(everything, text)
    if added_kg < 0.0:
        text = (
            f"In {' and '.join(everything)} the flange carried about {-added_kg:.2g} kg more "
            f"without load than with {name}: the two were exchanged. {again}"
        )
        return Mistake(everything, text)
    lower, upper = SAME_BODY
    if not lower <= added_kg / body.mass_kg <= upper:
        text = (
            f"The flange carried about {added_kg:.2g} kg by the nameplate gains, and {name} has "
            f"{body.mass_kg:g} kg: another body was mounted, or the nameplate is far off."
        )
        return Mistake((last.name,), text)
    return None


def _nameplate_gain(axis: CellAxis) -> Gain:
    nameplate = axis.nameplate_gain
    return Gain(axis=axis.name, value=nameplate, std=0.0, unit=axis.gain_unit, nameplate=nameplate)


def _with_nameplate_gains(cell: Cell) -> Calibration:
    """Return a calibration that has the nameplate gains, and nothing else."""
    gains = tuple(map(_nameplate_gain, cell.axes))
    relative_error_percent = RelativeError((0.0,) * len(gains), 0.0)
    return Calibration(
        cell=cell.name,
        method="none",
        gains=gains,
        parameters=(),
        effects=(),
        relative_error_percent=relative_error_percent,
        holdout_error_percent=None,
        condition=1.0,
        rows=0,
        filter={},
        sources=(),
        configuration_sha256=cell.digest,
        created="",
        software="",
    )
