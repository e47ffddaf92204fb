"""The journal of a session in plain words, for the person at the terminal.

The events are those that the other forms of the journal have. One that is missing here is for programs alone, unless it
is a warning or an error.
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
    """A journal for a person: short lines without times, and one table of the gains after a block."""

    said: set[str] = field(default_factory=set)  #: warnings that were printed; the same one once is enough

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
    tell = SENTENCES.get(event)
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
        verdict = "✓" if is_precise else f"not yet: {gain['std_percent'] / gain['target_percent']:.1f} × the target"
        value = f"{gain['value']:10.4g} {gain['unit']}"
        lines.append(f"  {gain['axis']:{width}} {value} ± {gain['std_percent']:.2f} %   {verdict}")
    worst = gains[0]
    target = f"{worst['target_percent']:g} %"
    left_s = fields["left_s"]
    if left_s > 0.0:
        lines.append(
            f"The target is ± {target}. {worst['axis']} needs the longest: about {left_s:.0f} s more, if σ falls with "
            "the root of the time."
        )
    else:
        lines.append(f"Every gain is within ± {target}: the recording is complete.")
    return "\n".join(lines)


def _begun(fields: Fields) -> str:
    return f"A new session begins. Its files are in {fields['folder']}."


def _taken_up(fields: Fields) -> str:
    return f"The session goes on where it was. Recorded already: {fields['recorded']}."


def _not_taken_up(fields: Fields) -> str:
    return f"! The unfinished session in {fields['folder']} is left as it is: {fields['reason']}."


def _compared(fields: Fields) -> str:
    return f"\nBeside the gains in the controller: {fields['words']}."


def _recorded(fields: Fields) -> str:
    lost = fields["lost_cycles"]
    return f"Recorded {fields['samples']} samples, {lost or 'none'} lost."


def _invalid(fields: Fields) -> str:
    return f"! This recording cannot be used ({fields['reason']}); it is kept, and the block is recorded again."


def _weighed(fields: Fields) -> str:
    return f"The moves show about {fields['added_kg']:.2g} kg more on the flange than without load."


def _identifying(fields: Fields) -> str:
    logs = len(fields["logs"])
    held_out = ", ".join(name.removesuffix(".mcap") for name in fields["holdout"])
    return f"\nIdentifying all gains from {logs} blocks; {held_out} is held out, to judge the model."


def _written(fields: Fields) -> str:
    return f"Written to {fields['file']}. The content before is in {fields['backup']}."


SENTENCES: dict[str, Callable[[Fields], str]] = {
    "session begun": _begun,
    "session taken up": _taken_up,
    "an unfinished session is not taken up": _not_taken_up,
    "the interlock lets the robot move": lambda fields: "Checked: disk, history and interlock.",
    "drives are as declared, without fault and without power": lambda fields: "Checked: the drives.",
    "moves to look at": lambda fields: f"\nThe moves of {fields['run']}, to look at first: {fields['page']}",
    "rehearsing": lambda fields: f"Rehearsing at {100.0 * fields['speed']:.0f} % of the speed; nothing is logged.",
    "recorded": _recorded,
    "recording is invalid": _invalid,
    "set aside": lambda fields: f"The earlier recording is kept as {fields['log']}.",
    "warning of the recorder": lambda fields: f"! {fields['text']}",
    "weighed": _weighed,
    "mistake in a block": lambda fields: f"\n! {fields['text']}",
    "kept as it is": lambda fields: f"{fields['block']} is kept as it is.",
    "gains so far": _gains,
    "the blocks so far do not give the gains": lambda fields: f"\n! The blocks so far give no gains: {fields['text']}",
    "diagnosis": lambda fields: f"! {fields['text']}",
    "identifying": _identifying,
    "found": lambda fields: f"  {fields['text']}",
    "certificate": lambda fields: f"Certificate: {fields['page']}",
    "drift": lambda fields: f"! {fields['axis']}: {fields['text']}",
    "compared with the gains in the controller": _compared,
    "a check failed": lambda fields: f"✗ {fields['text']}",
    "written to the controller's file": _written,
    "proposed: an operator has to apply it": lambda fields: "Nothing was written.",
    "session ended": lambda _: "",  # the summary or the error follows
    "accepted": lambda fields: f"✓ Accepted: {fields['text']}.",
    "not accepted": lambda fields: f"✗ Not accepted: {fields['text']}.",
}
"""What a person reads of an event, by its words in the journal."""
