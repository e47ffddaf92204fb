"""Clean simulated cells, several seeds: how far the gains are off,
and whether an effect is seen that is not there.

Run by `make gain-study`; writes out/gain-study.json and prints the table of
docs/evidence/estimators.md.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daq.simulation.demo import ProgressReporter, Settings, demo_gains, demonstrate
from daq.simulation.simulation_file import shipped_simulation

OUT = Path("out/gain-study")
SEEDS = (1, 2, 3, 4)
DURATION_S = 40.0


def one(seed: int) -> dict[str, Any]:
    """The demonstration on a clean cell."""
    quiet = ProgressReporter(lambda _: None, lambda _done, _total, _remark: None)
    settings = Settings(OUT / str(seed), shipped_simulation("clean"), seed, DURATION_S)
    outcome = demonstrate(settings, lambda: datetime.now(UTC), quiet)
    gains = demo_gains(outcome)
    paper = outcome.fitted.paper
    assert paper is not None  # no gain is held fixed
    ml = [gain.error_percent for gain in gains]
    tls = []
    for gain, value in zip(gains, paper.gains.tolist(), strict=True):
        error_percent = 100.0 * (value / gain.truth - 1.0)
        tls.append(error_percent)
    scores = []
    for gain in gains:
        if gain.std_percent is not None:
            scores.append(gain.error_percent / gain.std_percent)
    total = outcome.calibration.relative_error_percent.total
    return {
        "seed": seed,
        "floor_percent": total,
        "ml_error_percent": ml,
        "tls_error_percent": tls,
        "scores": scores,
        "effects": [effect.name for effect in outcome.calibration.effects],
    }


def error_sizes(rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    """Mean and largest size of the gain errors of all rows [%]."""
    sizes: list[float] = []
    for row in rows:
        sizes.extend(abs(error) for error in row[key])
    return {"mean_percent": sum(sizes) / len(sizes), "max_percent": max(sizes)}


def main() -> int:
    """All seeds, two at a time."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        rows = pool.map(one, SEEDS, chunksize=1)
    sizes = {
        "ml": error_sizes(rows, "ml_error_percent"),
        "tls": error_sizes(rows, "tls_error_percent"),
    }
    false_effects = sum(len(row["effects"]) for row in rows)
    result = {"runs": rows, **sizes, "false_effects": false_effects}
    text = json.dumps(result, indent=2)
    OUT.with_suffix(".json").write_text(text + "\n")
    joints = " | ".join(f"J{n + 1} %" for n in range(6))
    lines = [f"| seed | floor % | {joints} | paper's TLS, mean / max % | effects |"]
    lines.append("|---" * 10 + "|")
    for row in rows:
        floor = f"{row['floor_percent']:.2f}"
        gains = " | ".join(f"{error:+.2f}" for error in row["ml_error_percent"])
        paper_size = error_sizes([row], "tls_error_percent")
        paper = f"{paper_size['mean_percent']:.1f} / {paper_size['max_percent']:.1f}"
        effect_count = len(row["effects"])
        lines.append(f"| {row['seed']} | {floor} | {gains} | {paper} | {effect_count} |")
    lines.append("")
    for name, size in sizes.items():
        mean = f"mean {size['mean_percent']:.2f} %"
        largest = f"max {size['max_percent']:.2f} %"
        lines.append(f"{name}: {mean}, {largest}")
    lines.append(f"effects found in clean cells: {false_effects}")
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
