"""Journal of a job: one line an event, as text, as JSON, or for the system's journal.

Under systemd a line is JSON after ``<N>``, its priority (sd-daemon(3)). That is chosen before the
journal's own protocol because it is one write to the stream that we were given: no socket that may
be full or absent, no limit of a datagram, and the order of everything else that goes to that stream
is kept. ``journalctl -p err`` finds what is wrong, and ``journalctl -o cat | jq`` reads the fields.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from enum import Enum, IntEnum
from typing import TextIO


class Level(IntEnum):
    """Priorities of syslog (RFC 5424, table 2)."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Form(Enum):
    """Format of the lines, by their reader."""

    TEXT = "text"  #: A person at a terminal
    JSON = "json"  #: A program
    JOURNAL = "journal"  #: systemd-journald, which takes the priority off


_IN_CONCLUSION = frozenset({"found"})
"""Events that the conclusion of a job, on standard output, has for a person.

A terminal would show them twice.
"""


_REPEATED_FIELDS = {"session ended": ("remark",)}
"""Fields that the conclusion, or the error that ends the command, has for a person."""


@dataclass(frozen=True, slots=True)
class Journal:
    """Where events go."""

    stream: TextIO  #: that lines are written to
    form: Form  #: of the lines
    now: Callable[[], datetime]  #: wall clock with time zone
    session: str = ""  #: session of the lines that follow
    step: str = ""  #: step of the lines that follow

    def say(self, level: Level, event: str, /, **fields: object) -> None:
        """Write one event; for a person, none that the conclusion repeats.

        Args:
            event: what happened, always in the same words.
            fields: plain JSON; what JSON has no word for is spelt as text.
        """
        if self.form is Form.TEXT and event in _IN_CONCLUSION:
            return
        line = self.line(level, event, **fields)
        # A reader that has gone is no reason to leave a robot half-way through its job.
        with suppress(OSError, ValueError):
            self.stream.write(line)
            self.stream.flush()

    def line(self, level: Level, event: str, /, **fields: object) -> str:
        """Return the line of an event, with its end; the arguments are those of `say`."""
        at = self.now().isoformat(timespec="milliseconds")
        if self.form is Form.TEXT:
            repeated = _REPEATED_FIELDS.get(event, ())
            words = [
                in_words(name, value) for name, value in fields.items() if name not in repeated
            ]
            details = ", ".join(filter(None, words))
            details = "".join(letter if letter.isprintable() else " " for letter in details)
            line = f"{at} "
            if self.step:
                line += f"{self.step}: "
            line += event
            if details:
                line += f": {details}"
        else:
            named = {}
            if self.session:
                named["session"] = self.session
            if self.step:
                named["step"] = self.step
            entry = {"time": at, "level": level.name.lower(), "event": event, **named, **fields}
            line = json.dumps(_plain(entry), ensure_ascii=False, allow_nan=False, default=str)
            if self.form is Form.JOURNAL:
                line = f"<{int(level)}>{line}"
        return line + "\n"


def in_words(name: str, value: object) -> str:
    """Return a field of an event as a person reads it; empty for one that is for programs alone."""
    if name in _FOR_PROGRAMS:
        return ""
    words = _value_in_words(value)
    if name in _SENTENCES:
        return words
    if isinstance(value, list | tuple) and name in _OF_EACH_AXIS:
        return f"{_OF_EACH_AXIS[name]}: {words}"
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return f"{_label(name.removesuffix(suffix))} {words} {unit}"
    return f"{_label(name)} {words}"


#: Fields that are sentences, and need no name
_SENTENCES = frozenset({"text", "remark", "reason", "words"})
_FOR_PROGRAMS = frozenset({"in_short", "differs", "error", "exit_code"})
_OF_EACH_AXIS = {"missing": "missing samples of each axis"}
_UNITS = {"_s": "s", "_mb": "MB", "_kg": "kg", "_percent": "%"}


def _label(name: str) -> str:
    return name.replace("_", " ")


def _yes_or_no(value: bool) -> str:
    if value:
        return "yes"
    return "no"


def _value_in_words(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return _yes_or_no(value)
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple) and any(value):
        return ", ".join(map(_value_in_words, value))
    if isinstance(value, list | tuple):
        return "none"
    return str(value)


def form_of(stream: TextIO, environment: Mapping[str, str]) -> Form:
    """Choose the form for a stream.

    Args:
        environment: of this process; systemd names device and inode of the stream that it reads in
            JOURNAL_STREAM (systemd.exec(5)), so that a stream that was redirected since is
            recognised.
    """
    if stream.isatty():
        return Form.TEXT
    with suppress(OSError, ValueError):
        found = os.fstat(stream.fileno())
        if environment.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}":
            return Form.JOURNAL
    return Form.JSON


def _plain(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
