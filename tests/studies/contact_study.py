"""False alarms an hour of thresholds that were learned from minutes of quiet motion,
and how high they are.

    python -m tests.studies.contact_study --tables docs/evidence/data

Residuals of six joints are drawn: first-order Gaussian autoregressions, or these transformed to a
marginal distribution of Student's t with five degrees of freedom. Each band is learned from quiet
minutes by `ident.contact.alarm_level`, and alarms in hours of later residual are counted by
`ident.contact.ExternalTorque`, as `contact` does. Later residual has the same scale, or one that is
15 % larger. The scale s is one known constant: what the fit of its four terms to real motion adds
is not in these figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal, stats

from daq.files import replace_file
from ident.arrays import FloatArray
from ident.contact import ALARMS_PER_HOUR, Band, ExternalTorque, alarm_level
from tests.studies.output import as_csv, print_line

JOINTS = 6
ROW_S = 0.02  #: As the fit decimates
STUDENT_DEGREES = 5.0
TAILS = ("Gaussian", "Student-5")
CORRELATIONS_S = (0.05, 0.2)
GROWTHS = (1.0, 1.15)  #: Scale of the later residual over that of the quiet minutes
QUIET_MINUTES = (2.0, 5.0, 15.0, 30.0)
FIRST_SEED = 1000  #: The thresholds' constants were chosen with seeds up to 30
BANDS = 40
HOURS = 50
#: Gaussian; rows of later residual below it on all joints raise no alarm, and are not kept
KEPT_SIGMAS = 3.0
FARTHEST_SIGMAS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Later:
    """Hours of residual without contact, of which only the large rows are kept.

    Attributes:
        time_s: of each kept row, shape (r,).
        torque: residual, shape (m, r).
        hours: how long it is.
    """

    time_s: FloatArray
    torque: FloatArray
    hours: int


def with_tail(gaussian: FloatArray, tail: str) -> FloatArray:
    """Transform a standard normal signal to the marginal distribution of one of TAILS,
    same shape.
    """
    if tail == "Gaussian":
        return gaussian
    nodes = np.linspace(0.0, FARTHEST_SIGMAS, 4001)
    quantiles = stats.t.isf(stats.norm.sf(nodes), STUDENT_DEGREES)
    size = np.interp(np.abs(gaussian), nodes, quantiles)
    return np.asarray(np.sign(gaussian) * size)


def sigma_of(tail: str) -> float:
    """Standard deviation of the signal of `with_tail`."""
    if tail == "Gaussian":
        return 1.0
    return float(np.sqrt(STUDENT_DEGREES / (STUDENT_DEGREES - 2.0)))


def autoregression(rng: np.random.Generator, rows: int, correlation_s: float) -> FloatArray:
    """Standard normal signal whose autocorrelation falls to 1/e in `correlation_s`, shape (JOINTS,
    rows).
    """
    lag_one = np.exp(-ROW_S / correlation_s)
    white = rng.standard_normal((JOINTS, rows))
    white[:, 1:] *= np.sqrt(1.0 - lag_one**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -lag_one], white, axis=1))


def later_residual(rng: np.random.Generator, tail: str, correlation_s: float, hours: int) -> Later:
    """Draw hours of residual."""
    rows_an_hour = round(3600.0 / ROW_S)
    times = []
    torques = []
    for hour in range(hours):
        gaussian = autoregression(rng, rows_an_hour, correlation_s)
        largest_absolute_gaussian = np.abs(gaussian).max(axis=0)
        kept = np.flatnonzero(largest_absolute_gaussian > KEPT_SIGMAS)
        times.append((hour * rows_an_hour + kept) * ROW_S)
        torques.append(with_tail(gaussian[:, kept], tail))
    torque = np.concatenate(torques, axis=1)
    time_s = np.concatenate(times)
    return Later(time_s, torque, hours)


def learned_levels(
    rng: np.random.Generator, tail: str, correlation_s: float, minutes: float
) -> FloatArray:
    """Threshold of each joint from quiet minutes, shape (JOINTS,)."""
    rows = round(60.0 * minutes / ROW_S)
    gaussian = autoregression(rng, rows, correlation_s)
    ratio = np.abs(with_tail(gaussian, tail))
    time_s: FloatArray = np.arange(rows) * np.float64(ROW_S)
    levels = []
    for joint in range(JOINTS):
        gap_s = 2.0 * correlation_s
        alarms_per_hour = ALARMS_PER_HOUR / JOINTS
        observed_s = 60.0 * minutes
        level = alarm_level(ratio[joint], time_s, gap_s, alarms_per_hour, observed_s)
        levels.append(np.nan if level is None else level)
    return np.array(levels)


def alarms_an_hour(
    levels: FloatArray, later: Later, correlation_s: float, growth: float = 1.0
) -> float:
    """False alarms of all joints together in an hour of later residual."""
    ones = np.ones(JOINTS)
    scale = np.zeros((JOINTS, 4))
    scale[:, 0] = 1.0
    band = Band(scale, ones, levels, correlation_s * ones, ones, ALARMS_PER_HOUR)
    shape = later.torque.shape
    use = np.ones(shape, dtype=np.bool_)
    torque_nm = growth * later.torque
    scale_nm = np.ones(shape)
    watched = ExternalTorque(
        time_s=later.time_s,
        torque_nm=torque_nm,
        scale_nm=scale_nm,
        use=use,
        band=band,
        from_itself=False,
        left_out=0,
    )
    return len(watched.contacts) / later.hours


def least_level(later: Later, correlation_s: float) -> float:
    """Level with ALARMS_PER_HOUR on this residual, for one who knows it:
    the lowest that any method could promise.
    """
    low = KEPT_SIGMAS
    absolute_torque = np.abs(later.torque)
    high = float(absolute_torque.max())
    for _ in range(25):
        middle = 0.5 * (low + high)
        levels = np.full(JOINTS, middle)
        if alarms_an_hour(levels, later, correlation_s) > ALARMS_PER_HOUR:
            low = middle
        else:
            high = middle
    return high


def measured_rows(
    tail: str, correlation_s: float, bands: int, hours: int, minutes: Sequence[float]
) -> list[str]:
    """Rows of the table for one kind of residual."""
    kind = [TAILS.index(tail), round(1000.0 * correlation_s)]
    later = later_residual(
        np.random.default_rng([FIRST_SEED - 1, *kind]), tail, correlation_s, hours
    )
    least = least_level(later, correlation_s) / sigma_of(tail)
    rows = []
    for quiet in minutes:
        levels = []
        for number in range(bands):
            rng = np.random.default_rng([FIRST_SEED + number, *kind, round(quiet)])
            levels.append(learned_levels(rng, tail, correlation_s, quiet))
        in_sigmas = np.array(levels) / sigma_of(tail)
        median = float(np.median(in_sigmas))
        for growth in GROWTHS:
            rates = np.array([alarms_an_hour(one, later, correlation_s, growth) for one in levels])
            above = int((rates > ALARMS_PER_HOUR).sum())
            cells = (
                tail,
                f"{correlation_s:g}",
                f"{growth:g}",
                f"{quiet:g}",
                f"{rates.mean():.2f}",
                f"{rates.max():.2f}",
                f"{above} of {bands}",
                f"{median:.1f}",
                f"{in_sigmas.min():.1f}",
                f"{in_sigmas.max():.1f}",
                f"{least:.1f}",
            )
            rows.append(f"| {' | '.join(cells)} |")
    return rows


HEADER = (
    "| tail | correlation, s | scale later | quiet, min | alarms/h, mean | worst band | bands "
    "above 1/h | level, σ | lowest | highest | least possible |"
)


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.contact_study", description=__doc__
    )
    parser.add_argument("--bands", type=int, default=BANDS)
    parser.add_argument("--hours", type=int, default=HOURS, help="of later residual")
    parser.add_argument("--tables", type=Path, help="folder for the table as CSV")
    options = parser.parse_args(arguments)
    lines = [HEADER, "|---" * (HEADER.count("|") - 1) + "|"]
    print_line("\n".join(lines))
    for tail in TAILS:
        for correlation_s in CORRELATIONS_S:
            rows = measured_rows(tail, correlation_s, options.bands, options.hours, QUIET_MINUTES)
            print_line("\n".join(rows))
            lines += rows
    if options.tables is not None:
        markdown = "\n".join(lines)
        content = as_csv(markdown).encode()
        path = options.tables / "contact.csv"
        replace_file(path, content)
    return 0


if __name__ == "__main__":
    sys.exit(main())
