"""False alarms of the diagnoses on clean recordings, and how often each planted mistake is named.

`make diagnosis-study` prints how often each diagnosis fires.
The arm is that of tests/ident/mistaken.py.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from ident.data.run import Run
from ident.errors import IdentificationError
from ident.estimators import diagnosis, payload_diagnosis
from ident.estimators.diagnosis import exchanged_channels
from ident.estimators.method import Method
from tests.ident.mistaken import AXES, BODY, SMALL, diagnosed, small_recordings, turned, with_currents
from tests.ident.recordings import Truth, three_axes_truth

NOISES_A = (0.02, 0.05, 0.1, 0.15)
LIMIT_NM = np.full(3, 99.0)


def named(truth: Truth, runs: Sequence[Run], holdout: Sequence[Run] = (), *, fixed: bool = False) -> list[str]:
    """Names of everything that is said of these runs, with the runs and axes that it points at."""
    method = Method.WLS if fixed else Method.ML
    names: list[str] = []
    try:
        found = diagnosed(truth, runs, holdout, method=method, fixed=fixed, effort_limit=LIMIT_NM)
        names += [" ".join((one.name, *one.runs, *one.axes)) for one in found]
    except IdentificationError as error:
        names.append(type(error).__name__)
    exchanged = exchanged_channels(truth.model, runs, SMALL, AXES)
    return names if exchanged is None else [*names, exchanged.name]


MISTAKES: dict[str, Callable[[Truth, int, bool], list[str]]] = {
    "r3 turned by 90 degrees": lambda t, s, f: named(
        t, small_recordings(t, s, count=6, bodies={3: turned(0.5 * np.pi)}), fixed=f
    ),
    "r3 without payload": lambda t, s, f: named(t, small_recordings(t, s, count=6, bodies={3: 0.0 * BODY}), fixed=f),
    "J2 and J3 exchanged": lambda t, s, f: named(t, with_currents(small_recordings(t, s), 1.0, (0, 2, 1)), fixed=f),
    "J2 reversed": lambda t, s, f: named(t, with_currents(small_recordings(t, s), np.array([1.0, -1.0, 1.0])), fixed=f),
    "mA": lambda t, s, f: named(t, with_currents(small_recordings(t, s), 1000.0), fixed=f),
}


def main(arguments: Sequence[str]) -> int:
    """Print the counts; 1 if a clean recording was named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=50)
    parser.add_argument("--mistaken", type=int, default=10)
    given = parser.parse_args(arguments)
    truth, alarms = three_axes_truth(), Counter[str]()
    for seed in range(given.cells):
        runs = small_recordings(truth, seed, count=5, noise_a=NOISES_A[seed % len(NOISES_A)])
        for fixed in (False, True):
            alarms.update(named(truth, runs[:4], runs[4:], fixed=fixed))
    _say(f"{given.cells} clean recordings, free and fixed gains: {sum(alarms.values())} false alarms {dict(alarms)}")
    for mistake, said in MISTAKES.items():
        for fixed in (False, True):
            counts = Counter(" + ".join(said(truth, seed, fixed)) or "nothing" for seed in range(given.mistaken))
            _say(f"{mistake}, gains {'fixed' if fixed else 'free'}: {dict(counts)}")
    _say(
        f"limits: share {payload_diagnosis.LEAST_SHARE:g}, p {payload_diagnosis.LARGEST_PROBABILITY:g}, "
        f"exchange {diagnosis.EXCHANGE:g}"
    )
    return int(bool(alarms))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
