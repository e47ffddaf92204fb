"""Gains of independent recordings of one simulated arm, after the search:
is their difference what σ says?

    python -m tests.studies.pairs_study --recordings 400 --minutes 60          both worlds, one shard
    python -m tests.studies.pairs_study --shard 2/4 --minutes 60               every fourth recording from the second on
    python -m tests.studies.pairs_study --recordings 0                         the tables of what is there

The arm has one truth and the undeclared effects of ARM_EFFECTS in every recording. Each recording
has random moves and a noise of its own: two runs of 20 s without load, two with the disc. Each is
fitted with the search, and knows nothing of the others. Pairs are disjoint, recordings 1 and 2, 3
and 4, …, so 400 recordings of a world are 200 independent pairs. For each pair and axis

    z = (g₁ − g₂) / √(σ₁² + σ₂²),

whose root mean square is 1 where σ is true. Scores are kept in out/pairs/<world>/, and are made
again when the search or the simulation changed; a study that was interrupted goes on where it was.
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.estimators.identify import identify
from tests.studies.direct_cell import MOVING, run_of
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.followed_cell import follow, point_to_point
from tests.studies.output import as_csv, print_line
from tests.studies.side_by_side import Shard, shard
from tests.studies.study_cells import declared_payload, spec_of, world_cell
from tests.studies.study_plans import CELL
from tests.studies.study_rows import with_tuples

OUT = Path("out/pairs")
ARM_SEED = 7001  #: Its truth; no cell of another study has it
PAIR_WORLDS = ("measurement", "loop3")
RECORDINGS = 400  #: Of each world: with two worlds, 400 pairs
DURATION_S = 20.0  #: Of each run
BETWEEN_S = 60.0  #: From the beginning of one run to that of the next
RUNS = (("bare-1", None), ("disc-1", "disc"), ("bare-2", None), ("disc-2", "disc"))
SHARD_MINUTES = 60.0  #: After which a shard begins no further recording
ARM_EFFECTS = (
    UndeclaredEffect("load-friction", 1, {"coefficient": 0.08}),
    UndeclaredEffect("stribeck", 3, {"rise_nm": 1.2, "speed_rad_s": 0.2}),
)
"""On J2 and J4, of the sizes of the effects study."""


@dataclass(frozen=True, slots=True)
class RecordingTask:
    """One recording of the arm.

    Attributes:
        out: folder of the study.
        world: of WORLDS.
        number: of the recording, from 0.
    """

    out: Path
    world: str
    number: int

    @property
    def path(self) -> Path:
        """File of the score."""
        return self.out / self.world / f"{self.number:04d}.json"


@dataclass(frozen=True, slots=True)
class RecordingScore:
    """Gains of one recording, in percent of the true gain.

    Attributes:
        world: of WORLDS.
        number: of the recording, from 0.
        error_percent: of the gain after the search, shape (n,).
        std_percent: its σ after the search, shape (n,).
        plain_error_percent: the same without any effect in the model.
        plain_std_percent: σ of that.
        effects: that the search accepted, as `family on J3`.
    """

    world: str
    number: int
    error_percent: tuple[float, ...]
    std_percent: tuple[float, ...]
    plain_error_percent: tuple[float, ...]
    plain_std_percent: tuple[float, ...]
    effects: tuple[str, ...]


def record_runs(
    cell: Cell, world: str, number: int, effects: tuple[UndeclaredEffect, ...] = ARM_EFFECTS
) -> tuple[Run, ...]:
    """Record the arm once: the truth is that of ARM_SEED,
    moves and noise are those of the recording's number.
    """
    arm = world_cell(ARM_SEED, world)
    runs = []
    for index, (name, payload) in enumerate(RUNS):
        spec = spec_of(arm, payload, index)
        # One stream of seeds for all recordings: no two of their runs have the same noise.
        noise_seed = 10_000_000 + len(RUNS) * number + index
        spec = replace(spec, effects=effects, seed=noise_seed)
        moves_rng = np.random.default_rng([ARM_SEED, number, index])
        demand = point_to_point(cell, spec.start_rad, moves_rng, DURATION_S)
        if payload is None:
            declared = None
        else:
            declared = declared_payload(payload)
        began_s = BETWEEN_S * index
        raw = follow(cell, spec, demand, name, declared, began_s)
        runs.append(run_of(raw, cell))
    return tuple(runs)


def score_recording(cell: Cell, world: str, number: int) -> RecordingScore:
    """Record the arm, fit it, and search its residual."""
    runs = record_runs(cell, world, number)
    found = identify(model_of(cell), runs, cell.conditioning)
    rng = np.random.default_rng(0)
    steps = find_effects(gather(found, runs), rng)
    end = steps[-1].after
    axes = world_cell(ARM_SEED, world).bare.axes
    gain_nm_per_a = [axis.gain_nm_per_a for axis in axes]
    true = np.array(gain_nm_per_a)
    plain = found.estimate
    searched = end.estimate
    difference = searched.gains - true
    error_percent = _percent(difference, true)
    std_percent = _percent(searched.gains_std, np.abs(true))
    gain_difference = plain.gains - true
    plain_error_percent = _percent(gain_difference, true)
    plain_std_percent = _percent(plain.gains_std, np.abs(true))
    effects = tuple(placed.name_among(cell.axis_names) for placed in end.effects)
    return RecordingScore(
        world=world,
        number=number,
        error_percent=error_percent,
        std_percent=std_percent,
        plain_error_percent=plain_error_percent,
        plain_std_percent=plain_std_percent,
        effects=effects,
    )


def _percent(difference: FloatArray, of: FloatArray) -> tuple[float, ...]:
    return tuple((100.0 * difference / of).tolist())


def make_score(task: RecordingTask, cell: Cell, fingerprint: str) -> str:
    """Score a recording unless that was done; return what was done."""
    if is_finished(task.path, fingerprint):
        return f"{task.world} {task.number}: kept"
    begun_s = time.process_time()
    score = score_recording(cell, task.world, task.number)
    task.path.parent.mkdir(parents=True, exist_ok=True)
    content = json.dumps(asdict(score)).encode()
    replace_file(task.path, content)
    finish(task.path, fingerprint)
    spent_s = time.process_time() - begun_s
    absolute_error_percent = np.abs(score.error_percent)
    worst = float(absolute_error_percent.max())
    found = ", ".join(score.effects) or "nothing"
    return f"{task.world} {task.number}: worst gain {worst:.2f} %, {spent_s:.0f} s, {found}"


def make_scores(
    tasks: Sequence[RecordingTask], minutes: float, *, clock_s: Callable[[], float] = time.monotonic
) -> Iterator[str]:
    """Score recordings one after the other; begin none after `minutes`."""
    cell = load_cell(CELL)
    rooms = (*MOVING, "tests.studies.followed_cell")
    simulating = digest_of_source("tests.studies.followed_cell", rooms)
    searching = digest_of_source("ident.discovery.loop")
    arms = {world: world_cell(ARM_SEED, world).bare for world in PAIR_WORLDS}
    fingerprints = {
        world: digest(
            simulating, searching, cell.digest, DURATION_S, arm.urdf, arm.axes, ARM_EFFECTS
        )
        for world, arm in arms.items()
    }
    end_s = clock_s() + 60.0 * minutes
    for task in tasks:
        if clock_s() >= end_s:
            return
        fingerprint = fingerprints[task.world]
        yield make_score(task, cell, fingerprint)


def load_scores(folder: Path, world: str) -> tuple[RecordingScore, ...]:
    """Scores of a world that are there, by number."""
    files = (folder / world).glob("*.json")
    sorted_files = sorted(files)
    documents = [json.loads(path.read_text()) for path in sorted_files]
    return tuple(RecordingScore(**with_tuples(document)) for document in documents)


def disjoint_pairs(
    scores: Sequence[RecordingScore],
) -> tuple[tuple[RecordingScore, RecordingScore], ...]:
    """Pair scores, each of which is in one pair:
    the first with the second, the third with the fourth, …
    """
    even = len(scores) - len(scores) % 2
    return tuple(zip(scores[0:even:2], scores[1:even:2], strict=True))


def pair_z(
    pairs: Sequence[tuple[RecordingScore, RecordingScore]], *, plain: bool = False
) -> FloatArray:
    """z of each pair and axis, shape (pairs, n); `plain` without the search."""
    values = []
    for first, second in pairs:
        if plain:
            difference = np.subtract(first.plain_error_percent, second.plain_error_percent)
            std = np.hypot(first.plain_std_percent, second.plain_std_percent)
        else:
            difference = np.subtract(first.error_percent, second.error_percent)
            std = np.hypot(first.std_percent, second.std_percent)
        values.append(difference / std)
    return np.array(values)


def truth_z(scores: Sequence[RecordingScore]) -> FloatArray:
    """Error over σ of each recording and axis, shape (recordings, n)."""
    return np.array([np.divide(score.error_percent, score.std_percent) for score in scores])


def rms_interval(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root mean square of each column, and its standard error by leaving out a row at a time,
    shape (n,) each.
    """
    count = len(z)
    square = z**2
    rms = np.sqrt(square.mean(axis=0))
    difference = square.sum(axis=0) - square
    without = np.sqrt(difference / (count - 1))
    spread = without - without.mean(axis=0)
    return rms, np.sqrt((count - 1) / count * (spread**2).sum(axis=0))


def tables(scores: Sequence[RecordingScore], axes: Sequence[str]) -> str:
    """Return a Markdown table of one world: z of pairs, z to the truth, and the errors."""
    pairs = disjoint_pairs(scores)
    lines = [f"| world | {len(pairs)} pairs | {' | '.join(axes)} |", "|---" * (len(axes) + 2) + "|"]
    world = scores[0].world
    for name, z in (
        ("z of pairs after the search, rms", pair_z(pairs)),
        ("z of pairs without it, rms", pair_z(pairs, plain=True)),
        ("error over σ after the search, rms", truth_z(scores)),
    ):
        rms, error = rms_interval(z)
        cells = [f"{value:.2f} ± {one:.2f}" for value, one in zip(rms, error, strict=True)]
        lines.append(f"| {world} | {name} | {' | '.join(cells)} |")
    error_percent = [score.error_percent for score in scores]
    errors = np.array(error_percent)
    std_percent = [score.std_percent for score in scores]
    stds = np.array(std_percent)
    bias = [f"{value:+.2f}" for value in errors.mean(axis=0)]
    scatter = [f"{value:.2f}" for value in errors.std(axis=0, ddof=1)]
    sigma = [f"{value:.2f}" for value in np.sqrt((stds**2).mean(axis=0))]
    lines.append(f"| {world} | mean error, % | {' | '.join(bias)} |")
    lines.append(f"| {world} | standard deviation, % | {' | '.join(scatter)} |")
    lines.append(f"| {world} | σ, rms, % | {' | '.join(sigma)} |")
    return "\n".join(lines)


def found_effects(scores: Sequence[RecordingScore]) -> str:
    """How often each set of effects was accepted, most frequent first."""
    counts: dict[str, int] = {}
    for score in scores:
        name = ", ".join(sorted(score.effects)) or "nothing"
        counts[name] = counts.get(name, 0) + 1
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return "; ".join(f"{count} × {name}" for name, count in ordered)


def main(arguments: list[str] | None = None) -> int:
    """Score what is missing, then print the tables of what is there."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.pairs_study", description=__doc__
    )
    parser.add_argument("--world", nargs="+", choices=PAIR_WORLDS, default=list(PAIR_WORLDS))
    parser.add_argument(
        "--recordings", type=int, default=RECORDINGS, help="of each world; two are a pair"
    )
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th recording from the i-th on"
    )
    parser.add_argument(
        "--minutes", type=float, default=SHARD_MINUTES, help="begin no recording after these"
    )
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--tables", type=Path, help="folder for the table as CSV")
    options = parser.parse_args(arguments)
    # Worlds in turn, so that an interrupted study has as many recordings of each.
    tasks = []
    for number in range(options.recordings):
        tasks += [RecordingTask(options.out, world, number) for world in options.world]
    for line in make_scores(options.shard.of(tasks), options.minutes):
        print_line(line)
    axes = load_cell(CELL).axis_names
    written = []
    for world in options.world:
        scores = load_scores(options.out, world)
        if len(scores) < 4:
            print_line(f"{world}: {len(scores)} recordings, too few for a table")
            continue
        shown = tables(scores, axes)
        print_line(
            f"\n{world}: {len(scores)} recordings; effects: {found_effects(scores)}\n\n{shown}"
        )
        written.append(shown)
    if options.tables is not None:
        text = "".join(as_csv(one) for one in written)
        path = options.tables / "pairs.csv"
        replace_file(path, text.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
