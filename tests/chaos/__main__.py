"""Play rounds of random faults: ``python -m tests.vcan.run python -m tests.chaos --seed 1 --minutes 10``.

A round is repeated by its seed and number: ``--seed 1 --round 17``. Log, frames and words of a round with
violations are kept in the folder that DRIVEGAIN_VCAN_OUT names.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from itertools import islice
from pathlib import Path

from tests.chaos.faults import rounds
from tests.chaos.processes import warm_up
from tests.chaos.rounds import Round, play
from tests.faults.test_scenario import PLAN
from tests.vcan.cells import write_cell, write_simulation
from tests.vcan.run import OUT

PERIOD_US = 20_000


def say(line: str) -> None:
    """Print one line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def describe(number: int, outcome: Round, seconds: float) -> str:
    """One line about a round."""
    faults = "; ".join(map(str, outcome.faults))
    verdict = "ok" if not outcome.violations else f"{len(outcome.violations)} VIOLATIONS"
    if outcome.unrestored:
        faults += f"; settings of {outcome.unrestored} not restored"
    return f"{number:4d}  {verdict}  exit {outcome.code}, {outcome.compared} values, {seconds:.0f} s: {faults}"


def main() -> int:
    """Play until the time is over; 1 if anything was violated."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 16))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--round", type=int, help="play this round alone, and show what the recorder says")
    wanted = parser.parse_args()
    say(f"chaos: seed {wanted.seed}")
    done, values, violated, kinds = 0, 0, [], Counter[str]()
    codes, late_s = Counter[int | None](), list[tuple[float, str]]()
    with tempfile.TemporaryDirectory(prefix="chaos-") as name:
        folder = Path(name)
        cell, plan = write_cell(folder, PERIOD_US, "timed"), folder / "plan.yaml"
        plan.write_text(PLAN, encoding="utf-8")
        simulation = write_simulation(folder, PERIOD_US).read_text(encoding="utf-8")
        warm_up(folder / "simulation.yaml")
        end_s = time.monotonic() + 60.0 * wanted.minutes
        first = 0 if wanted.round is None else wanted.round - 1
        last = None if wanted.round is None else wanted.round
        for number, faults in islice(enumerate(rounds(wanted.seed), 1), first, last):
            if time.monotonic() > end_s:
                break
            begun_s, place = time.monotonic(), folder / str(number)
            place.mkdir()
            outcome = play(faults, place, cell, simulation, plan)
            say(describe(number, outcome, time.monotonic() - begun_s))
            if wanted.round is not None or outcome.violations:
                say(outcome.said)
            for line in outcome.violations:
                say(f"      {line}")
            if outcome.violations and os.environ.get(OUT):
                shutil.copytree(place, Path(os.environ[OUT], "chaos", f"{wanted.seed}-{number}"), dirs_exist_ok=True)
            done, values = done + 1, values + outcome.compared
            kinds.update(fault.name for fault in outcome.injected)
            codes[outcome.code] += 1
            late_s += [(one_s, name) for name, one_s in outcome.late_s.items()]
            violated += [number] if outcome.violations else []
            shutil.rmtree(place)
    say(f"\nseed {wanted.seed}: {done} rounds, {kinds.total()} faults of {len(kinds)} kinds, {values} values compared")
    say("\n".join(f"{count:4d}  {kind}" for kind, count in sorted(kinds.items())))
    say("exit codes: " + ", ".join(f"{code} ({count})" for code, count in sorted(codes.items(), key=str)))
    latest = ", ".join(f"{one_s:+.3f} ({name})" for one_s, name in sorted(late_s, reverse=True)[:5])
    say(f"stops after faults in motion: {len(late_s)}; latest, beside their bounds [s]: {latest}")
    for number in violated:
        say(f"violated: make chaos SEED={wanted.seed} ROUND={number}")
    say(f"{len(violated)} rounds with violations")
    return int(bool(violated))


if __name__ == "__main__":
    sys.exit(main())
