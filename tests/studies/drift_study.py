"""How often a drift of a gain is found, how soon, and how often one is found that is not there.

`make drift-study` prints the tables of docs/evidence/drift.md. Histories are drawn, not simulated:
gains with normal errors whose σ is known as well as a fit of thirty moves knows it, and scatter
more than that σ by a factor. Every recalibration is judged as it is at the cell, from the
calibrations up to that day, dispersion included.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ident.drift.change import CHART, DISPERSION, Chart, cusum_paths, dispersions, trend_statistic

FloatArray = NDArray[np.float64]

AXES = 6
RECALIBRATIONS = 24
DRIFT_PERCENT = 3.0
RAMP = 12
MOVES = 30
"""A jackknife over so many moves knows σ itself to 13 %."""
FOUND_SIGMAS = 3.0
NEVER = 10**6
SCATTER = DISPERSION
"""True scatter over σ in the tables of drifts."""


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of histories with an alarm [%]: by its kind, and of whatever kind."""

    cusum: float
    single: float
    trend: float
    any: float


@dataclass(frozen=True, slots=True)
class Delay:
    """How soon a drift was found.

    Attributes:
        reached: recalibrations from its beginning until it has cumulated FOUND_SIGMAS.
        cusum, any: one a history: recalibrations from then to the alarm, of the CUSUM and of
            whatever kind; negative before, NEVER where it was not found.
    """

    reached: int
    cusum: NDArray[np.int64]
    any: NDArray[np.int64]


def share_percent(late: NDArray[np.int64], within: int) -> float:
    """Found at most so many recalibrations after it had cumulated FOUND_SIGMAS [%]."""
    return float(100.0 * np.mean(late <= within))


def draw(
    rng: np.random.Generator, shape: tuple[int, ...], dispersion: float
) -> tuple[FloatArray, FloatArray]:
    """Errors of gains in units of their true σ, and σ as the fits report it."""
    reported = np.sqrt(rng.chisquare(MOVES, shape) / MOVES)
    return dispersion * rng.standard_normal(shape), reported


def false_alarms(
    rng: np.random.Generator,
    histories: int,
    *,
    dispersion: float,
    chart: Chart = CHART,
    count: int = RECALIBRATIONS,
) -> Shares:
    """Histories of AXES axes without drift that have an alarm at some time."""
    values, stds = draw(rng, (histories, AXES, count), dispersion)
    seen = np.zeros((3, histories), bool)
    for alarms in _days(values, stds, chart):
        seen |= alarms.any(axis=-1)
    cusum, single, slope = (100.0 * float(kind.mean()) for kind in seen)
    return Shares(cusum, single, slope, 100.0 * float(seen.any(axis=0).mean()))


def delays(
    rng: np.random.Generator,
    histories: int,
    *,
    std_percent: float,
    before: int,
    dispersion: float = SCATTER,
    chart: Chart = CHART,
) -> Delay:
    """When DRIFT_PERCENT on the first axis, linear over RAMP recalibrations after stable ones,
    raises an alarm there.

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
    values, stds = draw(rng, (histories, AXES, before + RAMP + 6), dispersion)
    values[:, 0] -= _ramp(step, before, values.shape[-1])
    cusum = np.full(histories, NEVER)
    of_any = np.full(histories, NEVER)
    for day, alarms in enumerate(_days(values, stds, chart), start=2):
        if day > before:
            first = alarms[..., 0]
            cusum[first[0] & (cusum == NEVER)] = day - before - reached
            of_any[first.any(axis=0) & (of_any == NEVER)] = day - before - reached
    return Delay(reached, cusum, of_any)


def most_percent(
    *, std_percent: float, before: int, false_percent: float, dispersion: float = SCATTER
) -> float:
    """Upper limit of detections by any test, two recalibrations after the drift has cumulated
    FOUND_SIGMAS [%].

    The two-sided test of that day (Neyman and Pearson) that knows σ, the day on which the drift
    began and its course, but neither the gain before nor the direction, and spends on this day what
    a chart has for all: `false_percent` over AXES axes.
    """
    step = DRIFT_PERCENT / RAMP / std_percent
    days = before + int(np.ceil(FOUND_SIGMAS / step - 1e-9)) + 2
    ramp = _ramp(step, before, days)
    ramp_difference = ramp - ramp.mean()
    ramp_difference_norm = np.linalg.norm(ramp_difference)
    sigmas = float(ramp_difference_norm) / dispersion
    limit = float(norm.isf(false_percent / 100.0 / AXES / 2.0))
    return 100.0 * float(norm.sf(limit - sigmas) + norm.cdf(-limit - sigmas))


def _ramp(step: float, before: int, count: int) -> FloatArray:
    difference = np.arange(1, count + 1) - before
    clipped_difference = np.clip(difference, 0, RAMP)
    return np.asarray(step * clipped_difference, float)


def _days(values: FloatArray, stds: FloatArray, chart: Chart) -> Iterator[NDArray[np.bool_]]:
    """Alarms of the newest calibration, from the second one on: CUSUM, single, trend;
    shape (3, histories, axes).
    """
    for day in range(2, values.shape[-1] + 1):
        known = values[..., :day]
        reported = stds[..., :day]
        dispersion = dispersions(known, reported)
        deviations, upper, lower = (
            found[..., -1] for found in cusum_paths(known, reported, dispersion, chart)
        )
        slopes = trend_statistic(known, reported, dispersion)[..., -1]
        yield np.stack(
            [
                np.maximum(upper, lower) > chart.threshold,
                np.abs(deviations) > chart.single,
                np.abs(slopes) > chart.trend,
            ]
        )


def main(arguments: list[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.drift_study", description=__doc__
    )
    parser.add_argument("--histories", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=20)
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    say = sys.stdout.write
    say(
        f"k = {CHART.reference:g}, h = {CHART.threshold:g}, single {CHART.single:g} σ, trend "
        f"{CHART.trend:g} σ, "
    )
    say(
        f"baseline of {CHART.baseline}; {options.histories} histories a line, seed "
        f"{options.seed}\n\n"
    )
    say(
        "| recalibrations without drift, six axes | true scatter / σ | CUSUM % | single % | trend "
        "% | any alarm % |\n"
    )
    say("|---|---|---|---|---|---|\n")
    for count, dispersion in ((24, 1.0), (24, SCATTER), (24, 1.2), (24, 1.5), (104, SCATTER)):
        # A long history costs by the square of its length.
        histories = options.histories // (1 + count // 60 * 7)
        shares = false_alarms(rng, histories, dispersion=dispersion, count=count)
        found = (shares.cusum, shares.single, shares.trend, shares.any)
        say(f"| {count} | {dispersion:g} | {' | '.join(f'{share:.2f}' for share in found)} |\n")
    say(
        "\n| σ of a gain % | stable before | 3 σ reached at | CUSUM: by then, within 2, "
        "within 4 % | "
    )
    say(
        "any alarm: by then, within 2, within 4 % | median delay | 95 % within | no test within 2 "
        "more than % |\n"
    )
    say("|---|---|---|---|---|---|---|---|\n")
    for before in (1, 2, 4, 8, 12, 24):
        for std_percent in (0.2, 0.3, 0.5, 0.8, 1.0):
            delay = delays(rng, options.histories // 5, std_percent=std_percent, before=before)
            cusum = ", ".join(f"{share_percent(delay.cusum, within):.0f}" for within in (0, 2, 4))
            of_any = ", ".join(f"{share_percent(delay.any, within):.0f}" for within in (0, 2, 4))
            middle, most = (
                int(np.quantile(delay.any, share, method="higher")) for share in (0.5, 0.95)
            )
            reported = " | ".join(
                "not by the end" if late == NEVER else f"{late:+d}" for late in (middle, most)
            )
            bound = most_percent(std_percent=std_percent, before=before, false_percent=1.1)
            say(
                f"| {std_percent:g} | {before} | {delay.reached} | {cusum} | {of_any} | {reported} "
                f"| {bound:.0f} |\n"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
