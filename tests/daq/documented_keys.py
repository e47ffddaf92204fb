"""Keys of the audit log's entries, as docs/reference/audit-and-history.md has them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from daq.ledger.audit import AuditEntry

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "audit-and-history.md"
DATA = {"document", "figures", "robot"}
"""Keys whose values are documents with keys that other pages describe."""
BY_RUN = "recalibration ended"  #: Its `logs` have the names of runs as keys


def _rows() -> dict[str, set[str]]:
    """What stands between backticks in the row of each action."""
    rows: dict[str, set[str]] = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        found = re.fullmatch(r"\| (`[^|]*`) \| (.*) \|", line)
        if found is None:
            continue
        words = set(re.findall(r"`([^`]*)`", found[2]))
        for action in re.findall(r"`([^`]*)`", found[1]):
            rows[action] = words
    return rows


def documented_keys(action: str) -> set[str]:
    """Keys that the page gives for an action, with those of an action that its row refers to."""
    rows = _rows()
    keys: set[str] = set()
    for word in rows[action]:
        if word in rows:
            keys |= rows[word]
        else:
            keys.add(word)
    return keys


def _keys_of(value: object) -> set[str]:
    """Keys of plain JSON, at any depth."""
    keys: set[str] = set()
    if isinstance(value, list):
        for item in value:
            keys |= _keys_of(item)
    if isinstance(value, dict):
        for key, item in value.items():
            keys.add(key)
            if key not in DATA:
                keys |= _keys_of(item)
    return keys


def written_keys(entries: Iterable[AuditEntry]) -> dict[str, set[str]]:
    """Keys of the details of entries, by their action."""
    keys: dict[str, set[str]] = {}
    for entry in entries:
        details = dict(entry.details)
        if entry.action.value == BY_RUN:
            details["logs"] = None
        known = keys.setdefault(entry.action.value, set())
        known |= _keys_of(details)
    return keys


def undocumented_keys(entries: Iterable[AuditEntry]) -> dict[str, set[str]]:
    """Keys that entries have and the page does not give, by the action."""
    found: dict[str, set[str]] = {}
    for action, keys in written_keys(entries).items():
        missing = keys - documented_keys(action)
        if missing:
            found[action] = missing
    return found
