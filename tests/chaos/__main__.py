"""Play rounds of random faults: ``python -m tests.chaos --seed 1 --minutes 10``.

It plays on vcan0 where there is one (``python -m tests.vcan.run python -m tests.chaos``), else over
a hub of drivegain on 127.0.0.1, without the acts that need the kernel's CAN. A round is repeated by
its seed and number: ``--seed 1 --round 17``. Log, frames and words of a round with violations are
kept in the folder that DRIVEGAIN_VCAN_OUT names. A round is played three times at most, if all that
it violates is a matter of time and the machine stood still meanwhile. With ``--results FILE`` every
round leaves a row, and a run that was broken off goes on behind its last one.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path

from tests.chaos import clock
from tests.chaos.ends import ChaosBus
from tests.chaos.faults import KINDS, NEEDS_CLOCK, Act, Inside, rounds
from tests.chaos.judge import Round
from tests.chaos.play import PERIOD_US, play
from tests.chaos.processes import hub_running, warm_up
from tests.chaos.results import Row, append_row, read_rows
from tests.faults.test_scenario import PLAN
from tests.vcan.cells import write_simulation
from tests.vcan.host_stalls import HostStalls, stalls_between
from tests.vcan.host_watch import watched, watching
from tests.vcan.run import INTERFACE, OUT

ATTEMPTS = 3
"""A round with violations is played again where the machine stood still meanwhile."""
EXCUSABLE = ("(c)", "(d)", "(e) exit code", "(listener)")


def say(line: str) -> None:
    """Print one line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def describe(number: int, outcome: Round, seconds: float) -> str:
    """One line about a round."""
    faults = "; ".join(map(str, outcome.faults))
    if not outcome.violations:
        verdict = "ok"
    else:
        verdict = f"{len(outcome.violations)} VIOLATIONS"
    if outcome.unrestored:
        faults += f"; settings of {outcome.unrestored} not restored"
    return (
        f"{number:4d}  {verdict}  exit {outcome.code}, {outcome.compared} values, {seconds:.0f} s: "
        f"{faults}"
    )


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 16))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument(
        "--round", type=int, help="play this round alone, and show what the recorder says"
    )
    parser.add_argument(
        "--hub", action="store_true", help="play over a hub even where there is vcan0"
    )
    parser.add_argument(
        "--results", type=Path, help="CSV file with a row for each round; a run goes on behind it"
    )
    return parser.parse_args()


def main() -> int:
    """Play until the time is over; 1 if anything was violated."""
    wanted = arguments()
    clock.begin_again("tests.chaos")
    # The round's processes end, too
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    stepped = clock.StepClock() if clock.available() else None
    done = read_rows(wanted.results, wanted.seed)
    played_s = sum(one.seconds for one in done)
    with ExitStack() as stack:
        stack.callback(clock.leave)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="chaos-")))
        on_kernel = not wanted.hub and (Path("/sys/class/net") / INTERFACE).exists()
        bus = ChaosBus()
        plan = folder / "plan.yaml"
        plan.write_text(PLAN, encoding="utf-8")
        simulation = write_simulation(folder, PERIOD_US)
        warm_up(simulation)
        if not on_kernel:
            bus = stack.enter_context(hub_running())
        kinds = possible_kinds(bus, stepped is not None)
        say(
            f"chaos: seed {wanted.seed} on {bus.address}, {len(kinds)} of {len(KINDS)} kinds "
            "of faults"
        )
        host_watch = folder / "host-watch"
        stack.enter_context(watching(host_watch))
        first = len(done)
        last = None
        if wanted.round is not None:
            first = wanted.round - 1
            last = wanted.round
        end_s = time.monotonic() + 60.0 * wanted.minutes - played_s
        for number, faults in islice(enumerate(rounds(wanted.seed, kinds), 1), first, last):
            if time.monotonic() > end_s:
                break
            begun_s = time.monotonic()
            place = folder / str(number)
            for attempt in range(1, ATTEMPTS + 1):
                place.mkdir()
                wall_s = time.time()
                outcome = play(
                    faults, place, bus, simulation.read_text(encoding="utf-8"), plan, stepped
                )
                stalls = stalls_between(watched(host_watch), wall_s, time.time())
                if attempt == ATTEMPTS or not is_excused(outcome, stalls):
                    break
                say(f"{number:4d}  played again, because {stalls}: {outcome.violations}")
                shutil.rmtree(place)
            seconds = time.monotonic() - begun_s
            say(describe(number, outcome, seconds))
            if wanted.round is not None or outcome.violations:
                say(outcome.said)
            for line in outcome.violations:
                say(f"      {line}")
            if outcome.violations and os.environ.get(OUT):
                shutil.copytree(
                    place,
                    Path(os.environ[OUT], "chaos", f"{wanted.seed}-{number}"),
                    dirs_exist_ok=True,
                )
            row = Row.of(wanted.seed, number, bus.port is None, outcome, seconds)
            done.append(row)
            if wanted.results is not None and wanted.round is None:
                append_row(wanted.results, row)
            shutil.rmtree(place)
    for line in summary(wanted.seed, done):
        say(line)
    return int(any(row.violations for row in done))


def is_excused(outcome: Round, stalls: HostStalls) -> bool:
    """Return whether the host's stalls may be the reason for all violations of a round.

    What they cannot explain: values that were not on the bus, motion without permission, and what
    is wrong with the files.
    """
    on_time = all(one.startswith(EXCUSABLE) for one in outcome.violations)
    return bool(outcome.violations) and on_time and stalls.excuse_a_failure


def possible_kinds(bus: ChaosBus, has_clock: bool) -> tuple[Act | Inside, ...]:
    """Return the kinds of faults that are possible on a bus."""
    absent = bus.absent
    if not has_clock:
        absent |= NEEDS_CLOCK
    return tuple(kind for kind in KINDS if kind not in absent)


def summary(seed: int, done: list[Row]) -> Iterator[str]:
    """Lines about all rounds of a seed."""
    kinds = Counter(chain.from_iterable(row.faults for row in done))
    codes = Counter(row.code for row in done)
    values = sum(row.values for row in done)
    yield (
        f"\nseed {seed}: {len(done)} rounds, {kinds.total()} faults of {len(kinds)} kinds, "
        f"{values} values compared"
    )
    neighbours = sum(row.neighbours for row in done)
    yield f"{neighbours} of them of the cycle before or after, in logs that are refused for that"
    writes = sum(row.writes for row in done)
    loads = [row.load for row in done]
    if done:
        yield (
            f"{writes} writes and checks of the audit log; load of the machine {min(loads)} to "
            f"{max(loads)}"
        )
    for kind, count in sorted(kinds.items()):
        yield f"{count:4d}  {kind}"
    yield "exit codes: " + ", ".join(f"{code} ({count})" for code, count in sorted(codes.items()))
    latest = max((row.latest_s for row in done if row.stops), default=0.0)
    yield (
        f"stops after faults in motion: {sum(row.stops for row in done)}; latest, beside its "
        f"bound: {latest:+.3f} s"
    )
    violated = [row.number for row in done if row.violations]
    for number in violated:
        yield f"violated: make chaos SEED={seed} ROUND={number}"
    yield f"{len(violated)} rounds with violations"


if __name__ == "__main__":
    sys.exit(main())
