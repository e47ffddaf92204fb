"""Carry the finished units of a study from one machine to another,
with the fingerprints of what they depend on.

    python -m tests.studies.kept_rows pack out/effects-study FILE
    python -m tests.studies.kept_rows unpack FILE out/effects-study

A study of several hours is done in pieces, on machines that forget. What is packed are its small
results alone, rows in JSON or CSV, one line of the file for each; recordings and plans are made
again. A study that finds a row with another fingerprint than its own does that unit again, so an
unpacked file never answers for code that has changed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from daq.files import replace_file
from tests.studies.fingerprint import finish, mark_of
from tests.studies.output import print_line

KINDS = (".json", ".csv")


def pack(folder: Path, file: Path) -> int:
    """Write the finished rows of a study's folder into one file; return their number."""
    lines = []
    for path in sorted(folder.rglob("*")):
        mark = mark_of(path)
        if path.suffix in KINDS and mark.is_file():
            text = mark.read_text(encoding="utf-8").strip()
            entry = {
                "path": path.relative_to(folder).as_posix(),
                "fingerprint": text,
                "text": path.read_text(encoding="utf-8"),
            }
            lines.append(json.dumps(entry, sort_keys=True))
    file.parent.mkdir(parents=True, exist_ok=True)
    content = "".join(f"{line}\n" for line in lines).encode()
    replace_file(file, content)
    return len(lines)


def unpack(file: Path, folder: Path) -> int:
    """Put packed rows into a study's folder, except where there is one already;
    return the number put there.
    """
    number = 0
    for line in file.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        path = folder / entry["path"]
        if mark_of(path).is_file():
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        content = entry["text"].encode()
        replace_file(path, content)
        finish(path, entry["fingerprint"])
        number += 1
    return number


def main(arguments: list[str] | None = None) -> int:
    """Pack or unpack."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.kept_rows", description=__doc__)
    parser.add_argument("action", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    options = parser.parse_args(arguments)
    act = pack if options.action == "pack" else unpack
    line = f"{act(options.source, options.target)} rows: {options.source} -> {options.target}"
    print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
