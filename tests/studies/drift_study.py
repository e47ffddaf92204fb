"""How often a drift of a gain is found, how soon, and how often one is found that is not there.

`python -m tests.studies.drift_study` prints the tables of docs/history.md. Histories are drawn, not simulated: gains
with normal errors whose σ is known as well as a fit of thirty moves knows it, and scatter more than that σ by a factor.
Every recalibration is judged as it is at the cell, from the calibrations up to that day, dispersion included.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.drift import dispersions
from ident.drift_chart import CHART, Chart, path

FloatArray = NDArray[np.float64]

AXES, RECALIBRATIONS = 6, 24
DRIFT_PERCENT, RAMP = 3.0, 12
MOVES = 30
"""A jackknife over so many moves knows σ itself to 13 %."""
FOUND_SIGMAS = 3.0
NEVER = 10**6


@dataclass(frozen=True, slots=True)
class Delay:
    """How soon a drift was found.

    Attributes:
        reached: recalibrations from its beginning until it has cumulated FOUND_SIGMAS.
        late: one a history: recalibrations from then to the alarm, negative before; NEVER where it was not found.
    """

    reached: int
    late: NDArray[np.int64]

    def share_percent(self, within: int) -> float:
        """Found at most so many recalibrations after it had cumulated FOUND_SIGMAS [%]."""
        return float(100.0 * np.mean(self.late <= within))


def draw(rng: np.random.Generator, shape: tuple[int, ...], dispersion: float) -> tuple[FloatArray, FloatArray]:
    """Errors of gains in units of their true σ, and σ as the fits tell it."""
    told = np.sqrt(rng.chisquare(MOVES, shape) / MOVES)
    return dispersion * rng.standard_normal(shape), told


def false_alarms(
    rng: np.random.Generator, histories: int, *, dispersion: float, chart: Chart = CHART, count: int = RECALIBRATIONS
) -> tuple[float, float]:
    """Share of histories of AXES axes without drift that have an alarm [%]: of the CUSUM, and of a single point."""
    values, stds = draw(rng, (histories, AXES, count), dispersion)
    added, single = np.zeros(histories, bool), np.zeros(histories, bool)
    for sums, deviation in _days(values, stds, chart):
        added |= (sums > chart.threshold).any(axis=1)
        single |= (deviation > chart.single).any(axis=1)
    return 100.0 * float(added.mean()), 100.0 * float(single.mean())


def delays(
    rng: np.random.Generator,
    histories: int,
    *,
    std_percent: float,
    before: int,
    dispersion: float = 1.05,
    chart: Chart = CHART,
) -> Delay:
    """When the CUSUM finds DRIFT_PERCENT on the first axis, linear over RAMP recalibrations, after stable ones.

    Args:
        rng: of the errors.
        histories: number of them.
        std_percent: σ of a gain in one calibration [%].
        before: stable calibrations before the drift begins.
        dispersion: true scatter over that σ.
        chart: limits.
    """
    step = DRIFT_PERCENT / RAMP / std_percent
    reached = int(np.ceil(FOUND_SIGMAS / step - 1e-9))
    count = before + RAMP + 6
    drift = step * np.clip(np.arange(1, count + 1) - before, 0, RAMP)
    values, stds = draw(rng, (histories, AXES, count), dispersion)
    values[:, 0] -= drift
    first = np.full(histories, NEVER)
    for day, (sums, _) in enumerate(_days(values, stds, chart), start=2):
        first[(sums[:, 0] > chart.threshold) & (first == NEVER)] = day - before
    return Delay(reached, np.where(first == NEVER, NEVER, first - reached))


def _days(values: FloatArray, stds: FloatArray, chart: Chart) -> list[tuple[FloatArray, FloatArray]]:
    """Larger CUSUM and magnitude of the deviation of the newest calibration, from the second one on."""
    found = []
    for day in range(2, values.shape[-1] + 1):
        known, told = values[..., :day], stds[..., :day]
        deviations, upper, lower = path(known, told, dispersions(known, told), chart)
        found.append((np.maximum(upper, lower)[..., -1], np.abs(deviations[..., -1])))
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.drift_study", description=__doc__)
    parser.add_argument("--histories", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=20)
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    say = sys.stdout.write
    say(f"k = {CHART.reference:g}, h = {CHART.threshold:g}, single {CHART.single:g} σ, baseline of {CHART.baseline}; ")
    say(f"{options.histories} histories a line, seed {options.seed}\n\n")
    say(
        "| recalibrations without drift, six axes | true scatter / σ | CUSUM alarm % | single alarm % |\n"
        "|---|---|---|---|\n"
    )
    for count, dispersion in ((24, 1.0), (24, 1.05), (24, 1.2), (24, 1.5), (104, 1.05)):
        added, single = false_alarms(
            rng, options.histories // (1 + count // 60 * 3), dispersion=dispersion, count=count
        )
        say(f"| {count} | {dispersion:g} | {added:.2f} | {single:.2f} |\n")
    say("\n| σ of a gain % | stable before | 3 σ reached at | found by then % | within 2 % | within 4 % | ")
    say("median delay | 95 % within |\n|---|---|---|---|---|---|---|---|\n")
    for before in (1, 4, 8, 12, 24):
        for std_percent in (0.2, 0.3, 0.5, 0.8, 1.0):
            delay = delays(rng, options.histories // 2, std_percent=std_percent, before=before)
            shares = " | ".join(f"{delay.share_percent(within):.1f}" for within in (0, 2, 4))
            middle, most = (int(np.quantile(delay.late, share, method="higher")) for share in (0.5, 0.95))
            told = " | ".join("not by the end" if late > RAMP + 6 else f"{late:+d}" for late in (middle, most))
            say(f"| {std_percent:g} | {before} | {delay.reached} | {shares} | {told} |\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
