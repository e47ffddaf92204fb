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
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from queue import Empty, Queue
from threading import Lock

from tests.mutation.coverage_map import (
    NO_TESTS_WERE_COLLECTED,
    CoverageMap,
    environment_of,
    measured_map,
)
from tests.mutation.fork_server import TIMED_OUT, ForkServer
from tests.mutation.mutants import Mutant, compiles, mutants_of
from tests.studies.output import print_line

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = ("daq", "drivers", "ident")

MIRRORED_S = 300.0
OTHERS_S = 150.0
UNSEEN_S = 60.0
"""Tests are tried, the cheapest files first, until their durations add up to this: a line that
every test executes would take an hour otherwise. The last is for a line that no test executes in
its own process.
"""

SLOWER = 3.0
"""A test that takes this many times its duration is taken as caught in an endless loop."""

START_S = 90.0
START_PROCESSOR_S = 20.0
"""Time and processor time for a run of pytest to start and to collect, on a busy machine."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One row of the study.

    `result` is "mirrored" or "other" for the tests that noticed, "survived", or "not executed"
    where no test runs the line in its own process and the tests of the room do not notice it
    either.
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


class Bench:
    """A tree that faults are planted into, with a process that runs its tests.

    Parameters
    ----------
    tree : checkout of its own.
    server : fork server in that tree.
    covered : which tests execute which line.

    """

    def __init__(self, tree: Path, server: ForkServer, covered: CoverageMap) -> None:
        self.tree = tree
        self._server = server
        self._covered = covered
        self._failing_without_fault: dict[str, bool] = {}

    def try_mutant(self, planted: Planted) -> Outcome:
        """Plant one fault, run the tests that could notice it, and take it out again."""
        mutant = planted.mutant
        result = "survived"
        noticed_by = ""
        for name, tests in self._groups(planted):
            noticed_by = self._noticed_by(planted, tests)
            if noticed_by:
                result = name
                break
        if not noticed_by and not self._covered.executes(planted.file, mutant.line):
            result = "not executed"
        return Outcome(
            planted.number,
            planted.file,
            mutant.line,
            mutant.kind,
            mutant.before,
            mutant.after,
            result,
            noticed_by,
        )

    def _groups(self, planted: Planted) -> tuple[tuple[str, list[str]], ...]:
        """Tests of the mirrored room, in two runs, and the others."""
        line = planted.mutant.line
        tests = self._covered.tests_that_could_notice(planted.file, line)
        own = [test for test in tests if mirrored(test, planted.file)]
        others = [test for test in tests if not mirrored(test, planted.file)]
        files = self._covered.cheapest_files(own, Path(planted.file).stem)
        first = [test for test in own if test.split("::")[0] in files[:1]]
        rest = [test for test in own if test not in set(first)]
        mirrored_s = MIRRORED_S
        others_s = OTHERS_S
        if not self._covered.executes(planted.file, line):
            mirrored_s = UNSEEN_S
            others_s = UNSEEN_S
        return (
            ("mirrored", first),
            ("mirrored", self._covered.affordable(rest, mirrored_s)),
            ("other", self._covered.affordable(others, others_s)),
        )

    def _noticed_by(self, planted: Planted, tests: list[str]) -> str:
        """First test that fails with the fault and passes without it, or nothing."""
        waiting = tests
        while waiting:
            noticed_by = self._first_that_fails_with(planted, waiting)
            if not noticed_by or not self._fails_without_fault(noticed_by, waiting):
                return noticed_by
            others = [test for test in waiting if not _is_of(test, noticed_by)]
            if len(others) == len(waiting):
                return ""
            waiting = others
        return ""

    def _first_that_fails_with(self, planted: Planted, tests: list[str]) -> str:
        path = self.tree / planted.file
        source = path.read_bytes()
        try:
            _write(path, planted.mutant.planted(source))
            return self._first_that_fails(tests)
        finally:
            _write(path, source)

    def _fails_without_fault(self, noticed_by: str, tests: list[str]) -> bool:
        """Whether a test fails here anyway: by chance, or as it is not run as in `make test`."""
        again = [test for test in tests if _is_of(test, noticed_by)]
        if not again:
            # It did not end, or ended without a name: all are suspected.
            return bool(self._first_that_fails(tests))
        if noticed_by not in self._failing_without_fault:
            self._failing_without_fault[noticed_by] = bool(self._first_that_fails(again))
        return self._failing_without_fault[noticed_by]

    def _first_that_fails(self, tests: list[str]) -> str:
        duration_s = self._covered.duration_s(tests)
        run = self._server.run(
            tests, START_S + SLOWER * duration_s, START_PROCESSOR_S + SLOWER * duration_s
        )
        if run.status in (0, NO_TESTS_WERE_COLLECTED):
            return ""
        if run.status == TIMED_OUT:
            return "timeout"
        for line in run.printed.splitlines():
            if line.startswith(("FAILED ", "ERROR ")):
                return line.split(" ", 1)[1].split(" - ")[0]
        return f"pytest ended with {run.status}"


def _is_of(test: str, named: str) -> bool:
    """Whether a test is the one that is named, or of the file that is named."""
    return test == named or test.split("::", maxsplit=1)[0] == named


_written_at_s = iter(range(1_000_000_000, 2_000_000_000))


def _write(path: Path, source: bytes) -> None:
    """Write a source file with a time of its own,
    so that no compiled file of before is taken for it.
    """
    path.write_bytes(source)
    stamp = next(_written_at_s)
    os.utime(path, (stamp, stamp))


def _tree_of_head(folder: Path) -> Path:
    """Clone of what is committed, where faults can be planted: some tests ask git for the files.

    A run that was killed has left its fault in there: it is taken out.
    """
    if folder.exists():
        subprocess.run(["git", "checkout", "--quiet", "--", "."], cwd=folder, check=True)
    else:
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
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=CHECKOUT / "out" / "mutation")
    arguments = parser.parse_args()
    ends_at_s = time.monotonic() + 60.0 * arguments.minutes
    tables = CHECKOUT / "docs" / "evidence" / "data" / f"mutants-{arguments.seed}.csv"

    clean = _tree_of_head(arguments.folder / "clean")
    covered = measured_map(clean, arguments.folder / "coverage", arguments.jobs)
    done = {outcome.number for outcome in _rows_of(tables)}
    mutants = chosen_mutants(clean, arguments.seed, arguments.mutants)
    waiting: Queue[Planted] = Queue()
    for planted in mutants:
        if planted.number not in done:
            waiting.put(planted)
    writing = Lock()

    def work(job: int) -> None:
        tree = _tree_of_head(arguments.folder / f"job-{job}")
        with ForkServer(tree, environment_of(tree)) as server:
            bench = Bench(tree, server, covered)
            while time.monotonic() < ends_at_s:
                try:
                    planted = waiting.get_nowait()
                except Empty:
                    return
                outcome = bench.try_mutant(planted)
                with writing:
                    _append(tables, outcome)
                    print_line(
                        f"{outcome.number:4d} {outcome.result:12s} "
                        f"{outcome.file}:{outcome.line} {outcome.kind}"
                    )

    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(work, range(arguments.jobs)))
    for line in summary(_rows_of(tables)):
        print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
