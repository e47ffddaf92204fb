"""Raw runs of a study in one compressed file, counts as the amplifiers report them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.model.bodies import Payload
from tests.studies.direct_cell import RawRun
from tests.studies.study_cells import declared_payload


def write_runs(path: Path, raw: Sequence[RawRun]) -> None:
    """Save runs; of their payloads the names alone."""
    arrays: dict[str, NDArray[Any]] = {}
    for run in raw:
        # Steps of positions are small numbers, which pack better than positions; the first one is a
        # step from zero.
        prepend = np.int32(0)
        position_steps_counts = np.diff(run.position_counts, axis=0, prepend=prepend)
        arrays[f"{run.name}.position_steps"] = position_steps_counts.T
        demand_count_difference = run.demand_counts - run.position_counts
        arrays[f"{run.name}.error_counts"] = demand_count_difference.T
        arrays[f"{run.name}.current_raw"] = run.current_raw.T
        arrays[f"{run.name}.limited"] = run.limited.T
        arrays[f"{run.name}.move"] = run.move.astype(np.int32)
        arrays[f"{run.name}.ampere_per_unit"] = run.ampere_per_unit
    payloads = {
        run.name: (None if run.payload is None else run.payload.name, run.began_s) for run in raw
    }
    with path.open("wb") as file:
        # The stubs take every keyword for `allow_pickle`.
        runs = np.array(json.dumps(payloads))
        np.savez_compressed(file, runs=runs, **arrays)  # type: ignore[arg-type]


def read_runs(
    path: Path, payload_of: Callable[[str], Payload] = declared_payload
) -> tuple[RawRun, ...]:
    """The runs of a file that `write_runs` made.

    Args:
        path: of the file.
        payload_of: a payload, as declared, by its name.
    """
    raw = []
    with np.load(path) as arrays:
        document = json.loads(str(arrays["runs"]))
        for name, (payload, began_s) in document.items():
            position = np.cumsum(arrays[f"{name}.position_steps"].T, axis=0, dtype=np.int32)
            raw_run = RawRun(
                name=name,
                payload=None if payload is None else payload_of(payload),
                began_s=began_s,
                position_counts=position,
                demand_counts=position + arrays[f"{name}.error_counts"].T,
                current_raw=np.ascontiguousarray(arrays[f"{name}.current_raw"].T),
                limited=np.ascontiguousarray(arrays[f"{name}.limited"].T),
                move=arrays[f"{name}.move"].astype(np.int64),
                ampere_per_unit=arrays[f"{name}.ampere_per_unit"],
            )
            raw.append(raw_run)
    return tuple(raw)
