"""The journal of a session in plain words, for the person at the terminal.

The events are those that the other forms of the journal have. One that is missing here is for
programs alone, unless it is a warning or an error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from daq.jobs.journal import Journal, Level
from daq.report.text import terminal_lines

Fields = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Story(Journal):
    """A journal for a person: short lines without times,
    and one table of the gains after a block.
    """

    #: warnings that were printed; the same one once is enough
    said: set[str] = field(default_factory=set)

    def say(self, level: Level, event: str, /, **fields: object) -> None:
        """Print one event, if it tells the person something."""
        text = _text(level, event, fields)
        if not text or (level is Level.WARNING and text in self.said):
            return
        if level is Level.WARNING:
            self.said.add(text)
        # A reader that has gone is no reason to leave a robot half-way.
        with suppress(OSError, ValueError):
            self.stream.write(f"{terminal_lines(text)}\n")
            self.stream.flush()


def _text(level: Level, event: str, fields: Fields) -> str:
    """Return what a person reads of an event; empty for one that tells nothing."""
    template = SENTENCES.get(event)
    if template is not None:
        return template.format_map(fields)
    tell = PARAGRAPHS.get(event)
    if tell is not None:
        return tell(fields)
    if level > Level.WARNING:
        return ""
    return f"! {event}: {fields.get('text', '')}"


def _gains(fields: Fields) -> str:
    """Return the gains after a block, the worst first, each with its σ and its target."""
    gains = sorted(fields["gains"], key=lambda gain: -gain["std_percent"] / gain["target_percent"])
    width = max(len(gain["axis"]) for gain in gains)
    lines = ["", f"Gains after {fields['blocks']} blocks, {fields['motion_s']:.0f} s of motion:"]
    for gain in gains:
        is_precise = gain["std_percent"] <= gain["target_percent"]
        verdict = "✓"
        if not is_precise:
            verdict = f"not yet: {gain['std_percent'] / gain['target_percent']:.1f} × the target"
        value = f"{gain['value']:10.4g} {gain['unit']}"
        std_percent = f"{gain['std_percent']:.2f} %"
        lines.append(f"  {gain['axis']:{width}} {value} ± {std_percent}   {verdict}")
    worst = gains[0]
    target = f"{worst['target_percent']:g} %"
    left_s = fields["left_s"]
    if left_s > 0.0:
        why = ""
        if worst.get("cause"):
            why = f" ({worst['cause']})"
        lines.append(
            f"The target is ± {target}. {worst['axis']} needs the longest{why}: about "
            f"{duration(left_s)} more at this rate."
        )
    else:
        lines.append(f"Every gain is within ± {target}: the recording is complete.")
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """Return a duration of motion in words: seconds up to two minutes, then minutes."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min"


def _gain_text(gain: Fields) -> str:
    return f"{gain['axis']} {gain['value']:.4g} ± {gain['std_percent']:.2f} %"


def _quick(fields: Fields) -> str:
    """Return the quick estimate after a move in one line, the worst gain first;
    before there is one, what it lacks.
    """
    if fields["missing"]:
        return f"No gains yet: {fields['missing']}."
    gains = fields["gains"]
    listed = ", ".join(map(_gain_text, gains))
    worst = gains[0]
    with_target = f"target ± {worst['target_percent']:g} %: {listed}."
    if fields["is_held_out"]:
        return f"Held out, not counted. Quick estimate so far, {with_target}"
    head = f"Quick estimate, move {fields['move']} of {fields['moves']}, {with_target}"
    left_s = fields["left_s"]
    if left_s <= 0.0:
        return f"{head} All at the target; the end of the block decides."
    return f"{head} {worst['axis']} is worst ({fields['why']}): about {duration(left_s)} left."


def _time_is_up(fields: Fields) -> str:
    """Return what was not reached in the time, and what would help."""
    lines = ["", f"The time is up. Not reached: {fields['missing']}.", "What would help:"]
    lines += [f"  {line}" for line in fields["would_help"]]
    return "\n".join(lines)


def _recorded(fields: Fields) -> str:
    lost = fields["lost_cycles"]
    if lost:
        return f"{lost} of {fields['samples']} samples lost."
    return ""


def _found(fields: Fields) -> str:
    """Return a sentence of what was found; the page has those of the details."""
    if fields["in_short"]:
        return f"  {fields['text']}"
    return ""


def _compared(fields: Fields) -> str:
    """Return how the gains compare; where they differ, the change that is shown next says it."""
    if fields["differs"]:
        return ""
    return f"\nCompared with the current gains, {fields['words']}."


def _identifying(fields: Fields) -> str:
    count = len(fields["logs"])
    held_out = ", ".join(name.removesuffix(".mcap") for name in fields["holdout"])
    return f"\nIdentifying from {count} blocks; {held_out} judges the model."


PARAGRAPHS: dict[str, Callable[[Fields], str]] = {
    "recorded": _recorded,
    "gains so far": _gains,
    "quick estimate": _quick,
    "time is up": _time_is_up,
    "identifying": _identifying,
    "found": _found,
    "compared with the gains in the controller": _compared,
}
"""What a person reads of an event where that is more than a sentence with its fields."""

SENTENCES = {
    "session begun": "New session: {folder}",
    "session taken up": "The session continues. Already recorded: {recorded}.",
    "an unfinished session is not taken "
    "up": "! The unfinished session in {folder} is not continued: {reason}.",
    "drives are as declared, without fault and without "
    "power": "Checked: disk, history, interlock, drives.",
    "planning": "Planning {duration_s:g} s of moves; a busy computer takes minutes.",
    "longer blocks": "{asked_s:g} s of moves are too short: found {found}; expected {expected}. "
    "The moves take {duration_s:g} s instead.",
    "moves to look at": "\nMoves to look at: {page}",
    "rehearsing": "Rehearsing at {speed:.0%} of the speed; nothing is logged.",
    "recording is "
    "invalid": "! This recording cannot be used: {reason}. It is kept, and the block is "
    "recorded again.",
    "set aside": "The earlier recording is now {log}.",
    "warning of the recorder": "! {text}",
    "this user cannot write the gains": "! This user cannot write the gains: {text}. The session "
    "ends with its certificate, and someone who may write can apply the calibration.",
    "weighed": "By the moves, {added_kg:.2g} kg more than without load.",
    "mistake in a block": "\n! {text}",
    "kept as it is": "{block} is used as it is.",
    "the blocks so far do not give the gains": "\n! The blocks so far give no gains: {text}",
    "certificate": "Certificate: {page}",
    "drift": "! {axis}: {text}",
    "a check failed": "✗ {text}",
    "written to the controller's file": "Written. Previous content: {backup}",
    "proposed: an operator has to apply it": "Nothing was written.",
    "session ended": "",  # the end of the session or the error follows
    "accepted": "✓ Accepted: {text}.\n",
    "not accepted": "✗ Not accepted: {text}. To undo the write: {undo}",
    "certified": "Certificate {id}",
}
"""The sentence of each event, with its fields."""
