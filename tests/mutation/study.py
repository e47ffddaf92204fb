"""Plant faults into the product, one at a time, and see whether a test notices.

`make mutation-study SEED=1 MUTANTS=300 MINUTES=55` goes on where it ended. A fault is tried with
the tests of its own room that execute its line first (*mirrored*), and with the other tests that
execute it where those pass. Rows go to a file for each seed beside the other evidence.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from queue import Queue

from tests.mutation.coverage_map import FAST, CoverageMap, environment_of, measured_map
from tests.mutation.mutants import Mutant, compiles, mutants_of
from tests.studies.output import print_line

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = ("daq", "drivers", "ident")

TESTS_AT_ONCE = 60
"""Tests given to one process of pytest:
a command line has a limit, and the fastest tests are tried first.
"""

SLOWER = 5.0
"""A test that takes this many times its duration is taken as caught in an endless loop."""

START_S = 60.0
"""Time for a process of pytest to start and to collect, on a busy machine."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One row of the study.

    `result` is "mirrored" or "other" for the tests that noticed, "survived", or "not executed"
    where no test of `make test` runs the line in its own process and the tests of the room do not
    notice it either.
    """

    number: int
    file: str
    line: int
    kind: str
    before: str
    after: str
    result: str
    noticed_by: str


@dataclass(frozen=True, slots=True)
class Planted:
    """A mutant and the file that it is planted into."""

    number: int
    file: str
    mutant: Mutant


def room_of(file: str) -> str:
    """Room of a source file: `ident/model` of `ident/model/base.py`,
    `ident` of `ident/weighing.py`.
    """
    parts = Path(file).parts
    return "/".join(parts[: min(2, len(parts) - 1)])


def mirrored(test: str, file: str) -> bool:
    """Whether a test stands in the room that mirrors a source file's."""
    room = room_of(file)
    inside = test.removeprefix("tests/").removeprefix(f"{room}/")
    if not test.startswith(f"tests/{room}/"):
        return False
    return "/" in room or "/" not in inside.split("::")[0]


def chosen_mutants(tree: Path, seed: int, count: int) -> tuple[Planted, ...]:
    """Mutants of all rooms: rooms in turn, a file by its number of places, then a kind,
    then a place.

    Kinds are drawn evenly, since constants and arguments would be four of ten otherwise.
    """
    rng = random.Random(seed)
    places = _places(tree)
    rooms = sorted({room_of(file) for file in places})
    chosen: list[Planted] = []
    seen: set[tuple[str, Mutant]] = set()
    while len(chosen) < count:
        room = rooms[len(chosen) % len(rooms)]
        file, mutant = _draw(rng, places, room)
        if (file, mutant) in seen or not compiles(mutant.planted((tree / file).read_bytes())):
            continue
        seen.add((file, mutant))
        chosen.append(Planted(len(chosen) + 1, file, mutant))
    return tuple(chosen)


def _places(tree: Path) -> dict[str, tuple[Mutant, ...]]:
    places: dict[str, tuple[Mutant, ...]] = {}
    for package in PACKAGES:
        for path in sorted((tree / package).rglob("*.py")):
            mutants = mutants_of(path.read_bytes())
            if mutants:
                places[str(path.relative_to(tree))] = mutants
    return places


def _draw(
    rng: random.Random, places: dict[str, tuple[Mutant, ...]], room: str
) -> tuple[str, Mutant]:
    files = [file for file in places if room_of(file) == room]
    sizes = [len(places[file]) for file in files]
    file = rng.choices(files, weights=sizes)[0]
    kinds = sorted({mutant.kind for mutant in places[file]})
    kind = rng.choice(kinds)
    mutant = rng.choice([mutant for mutant in places[file] if mutant.kind == kind])
    return file, mutant


def try_mutant(planted: Planted, tree: Path, covered: CoverageMap) -> Outcome:
    """Plant one fault into a tree of its own, run the tests that could notice it,
    and take it out again.
    """
    path = tree / planted.file
    source = path.read_bytes()
    try:
        _write(path, planted.mutant.planted(source))
        result, test = _verdict(planted, tree, covered)
    finally:
        _write(path, source)
    mutant = planted.mutant
    return Outcome(
        planted.number,
        planted.file,
        mutant.line,
        mutant.kind,
        mutant.before,
        mutant.after,
        result,
        test,
    )


_written_at_s = iter(range(1_000_000_000, 2_000_000_000))


def _write(path: Path, source: bytes) -> None:
    """Write a source file with a time of its own,
    so that no compiled file of before is taken for it.
    """
    path.write_bytes(source)
    stamp = next(_written_at_s)
    os.utime(path, (stamp, stamp))


def _verdict(planted: Planted, tree: Path, covered: CoverageMap) -> tuple[str, str]:
    tests = covered.tests_of(planted.file, planted.mutant.line)
    if not tests or covered.runs_at_import(planted.file, planted.mutant.line):
        name, noticed_by = _verdict_of_room(planted, tree)
        if noticed_by or not tests:
            return name, noticed_by
    own = [test for test in tests if mirrored(test, planted.file)]
    others = [test for test in tests if not mirrored(test, planted.file)]
    for name, group in (("mirrored", own), ("other", others)):
        noticed_by = _first_that_fails(group, tree, covered)
        if noticed_by:
            return name, noticed_by
    return "survived", ""


def _verdict_of_room(planted: Planted, tree: Path) -> tuple[str, str]:
    """Judge a line that runs at import or in other processes:
    by the tests of its room, then by the pipeline's.
    """
    room = f"tests/{room_of(planted.file)}"
    for name, folder in (("mirrored", room), ("other", "tests/pipeline")):
        if not (tree / folder).is_dir():
            continue
        noticed_by = _run([folder], tree, timeout_s=1200.0)
        if noticed_by:
            return name, noticed_by
    return "not executed", ""


def _first_that_fails(tests: list[str], tree: Path, covered: CoverageMap) -> str:
    for first in range(0, len(tests), TESTS_AT_ONCE):
        some = tests[first : first + TESTS_AT_ONCE]
        duration_s = sum(covered.durations_s.get(test, 1.0) for test in some)
        noticed_by = _run(some, tree, timeout_s=START_S + SLOWER * duration_s)
        if noticed_by:
            return noticed_by
    return ""


def _run(tests: list[str], tree: Path, timeout_s: float) -> str:
    """First test that fails, "timeout", or nothing where all pass."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "-m",
        FAST,
        *tests,
    ]
    process = subprocess.Popen(
        command,
        cwd=tree,
        env=environment_of(tree),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        printed, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "timeout"
    if process.returncode in (0, 5):
        return ""
    failed = [line for line in printed.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if failed:
        return failed[0].split(" ", 1)[1].split(" - ")[0]
    return f"pytest ended with {process.returncode}"


def _tree_of_head(folder: Path) -> Path:
    """Clone of what is committed, where faults can be planted: some tests ask git for the files."""
    if not folder.exists():
        part = folder.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "clone", "--quiet", "--local", str(CHECKOUT), str(part)], check=True)
        part.rename(folder)
    return folder


def _rows_of(file: Path) -> list[Outcome]:
    if not file.exists():
        return []
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [_outcome_of(row) for row in rows]


def _outcome_of(row: dict[str, str]) -> Outcome:
    return Outcome(
        number=int(row["number"]),
        file=row["file"],
        line=int(row["line"]),
        kind=row["kind"],
        before=row["before"],
        after=row["after"],
        result=row["result"],
        noticed_by=row["noticed_by"],
    )


def _append(file: Path, outcome: Outcome) -> None:
    begins = not file.exists()
    with file.open("a", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        if begins:
            writer.writerow([field.name for field in fields(Outcome)])
        writer.writerow(astuple(outcome))


def summary(outcomes: list[Outcome]) -> Iterator[str]:
    """Lines with the share of mutants that were noticed, in all and by room."""
    by_room: dict[str, Counter[str]] = {}
    for outcome in outcomes:
        by_room.setdefault(room_of(outcome.file), Counter())[outcome.result] += 1
    total: Counter[str] = Counter()
    for room, results in sorted(by_room.items()):
        total.update(results)
        yield _share(room, results)
    yield _share("all rooms", total)


def _share(room: str, results: Counter[str]) -> str:
    count = results.total()
    noticed = results["mirrored"] + results["other"]
    missed = count - noticed
    by_mirrored = results["mirrored"]
    return (
        f"{room:22s} {count:4d} mutants, noticed {noticed:4d}, by the mirrored tests "
        f"{by_mirrored:4d}, missed {missed}"
    )


def main() -> int:
    """Try mutants until all are tried or the time is over."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mutants", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=55.0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=CHECKOUT / "out" / "mutation")
    arguments = parser.parse_args()
    ends_at_s = time.monotonic() + 60.0 * arguments.minutes
    tables = CHECKOUT / "docs" / "evidence" / "data" / f"mutants-{arguments.seed}.csv"

    clean = _tree_of_head(arguments.folder / "clean")
    covered = measured_map(clean, arguments.folder / "coverage", arguments.jobs)
    trees: Queue[Path] = Queue()
    for job in range(arguments.jobs):
        trees.put(_tree_of_head(arguments.folder / f"job-{job}"))

    done = {outcome.number for outcome in _rows_of(tables)}
    mutants = chosen_mutants(clean, arguments.seed, arguments.mutants)

    def work(planted: Planted) -> Outcome | None:
        if time.monotonic() > ends_at_s:
            return None
        tree = trees.get()
        try:
            return try_mutant(planted, tree, covered)
        finally:
            trees.put(tree)

    waiting = [planted for planted in mutants if planted.number not in done]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for finished in as_completed([pool.submit(work, planted) for planted in waiting]):
            outcome = finished.result()
            if outcome is not None:
                _append(tables, outcome)
                print_line(
                    f"{outcome.number:4d} {outcome.result:12s} "
                    f"{outcome.file}:{outcome.line} {outcome.kind}"
                )
    for line in summary(_rows_of(tables)):
        print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
