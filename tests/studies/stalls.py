"""How late a sleeper of the highest priority wakes:
what the machine itself takes from every program on it.

    sudo chrt -f 50 python -m tests.studies.stalls 3600 > stalls.txt

prints time [s since 1970] and lateness [ms] of every wake-up that is late by more than LATE_MS.
"""

from __future__ import annotations

import sys
import time

PERIOD_NS = 2_000_000
LATE_MS = 12.0


def main(seconds: float) -> None:
    """Sleep from period to period, and print what is late."""
    due_ns = time.monotonic_ns() + PERIOD_NS
    end_ns = due_ns + round(1e9 * seconds)
    while due_ns < end_ns:
        wait_ns = due_ns - time.monotonic_ns()
        time.sleep(max(0, wait_ns) * 1e-9)
        now_ns = time.monotonic_ns()
        late_ms = 1e-6 * (now_ns - due_ns)
        if late_ms > LATE_MS:
            sys.stdout.write(f"{time.time():.3f} {late_ms:.1f}\n")
            sys.stdout.flush()
        due_ns = max(due_ns + PERIOD_NS, now_ns)


if __name__ == "__main__":
    main(float(sys.argv[1]))
