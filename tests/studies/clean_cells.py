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
    tls = [
        100.0 * (value / gain.truth - 1.0)
        for gain, value in zip(gains, paper.gains.tolist(), strict=True)
    ]
    total = outcome.calibration.relative_error_percent.total
    return {
        "seed": seed,
        "floor_percent": total,
        "ml_error_percent": ml,
        "tls_error_percent": tls,
        "scores": [
            gain.error_percent / gain.std_percent for gain in gains if gain.std_percent is not None
        ],
        "effects": [effect.name for effect in outcome.calibration.effects],
    }


def main() -> int:
    """All seeds, two at a time."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        rows = pool.map(one, SEEDS, chunksize=1)
    ml = [abs(error) for row in rows for error in row["ml_error_percent"]]
    tls = [abs(error) for row in rows for error in row["tls_error_percent"]]
    sizes = {
        name: {"mean_percent": sum(e) / len(e), "max_percent": max(e)}
        for name, e in (("ml", ml), ("tls", tls))
    }
    false_effects = sum(len(row["effects"]) for row in rows)
    result = {"runs": rows, **sizes, "false_effects": false_effects}
    text = json.dumps(result, indent=2)
    OUT.with_suffix(".json").write_text(text + "\n")
    lines = [
        "| seed | "
        "floor % | " + " | ".join(f"J{n + 1} %" for n in range(6)) + " | paper's TLS, mean / max % "
        "| effects |"
    ]
    lines.append("|---" * 10 + "|")
    for row in rows:
        gains = " | ".join(f"{error:+.2f}" for error in row["ml_error_percent"])
        paper_errors = [abs(error) for error in row["tls_error_percent"]]
        paper = f"{sum(paper_errors) / len(paper_errors):.1f} / {max(paper_errors):.1f}"
        lines.append(
            f"| {row['seed']} | {row['floor_percent']:.2f} | {gains} | {paper} | "
            f"{len(row['effects'])} |"
        )
    lines.append("")
    lines += [
        f"{name}: mean {size['mean_percent']:.2f} %, max {size['max_percent']:.2f} %"
        for name, size in sizes.items()
    ]
    lines.append(f"effects found in clean cells: {false_effects}")
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
