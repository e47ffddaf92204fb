"""Masses of several payloads that contradict each other are named together,
and no run is blamed for them.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from ident.data.run import Run
from ident.errors import Diagnosis, MassesContradict
from ident.model.bodies import Payload
from tests.ident.mistaken import BODY, diagnosed, small_recordings
from tests.ident.recordings import three_axes_truth

TRUTH = three_axes_truth()
DECLARED_KG = 2.0  #: Of the plate
PLATE = Payload("plate", "b", {"m": DECLARED_KG})


def recordings(plate_kg: float, *, count: int = 4) -> list[Run]:
    """Runs without load and with the disc in turn, and two with a plate that is declared 2 kg."""
    plate = BODY * (plate_kg / BODY[-1])
    bodies = {count + 1: plate, count + 3: plate}
    runs = small_recordings(TRUTH, 0, count=count + 4, bodies=bodies)
    of_plate = [replace(runs[index], payload=PLATE) for index in (count + 1, count + 3)]
    return [*runs[:count], *of_plate]


def of_payloads(runs: list[Run]) -> list[Diagnosis]:
    """What is said of the payloads."""
    return [
        one
        for one in diagnosed(TRUTH, runs)
        if one.name in {"masses-contradict", "payload-differs"}
    ]


def test_masses_that_agree_are_not_named() -> None:
    assert not of_payloads(recordings(DECLARED_KG))


@pytest.mark.slow
@pytest.mark.parametrize(("times", "first"), [(1.3, "plate"), (0.75, "disc")])
def test_masses_that_contradict_each_other_are_named_together(times: float, first: str) -> None:
    runs = recordings(times * DECLARED_KG)
    (found,) = of_payloads(runs)
    assert (found.name, found.runs) == ("masses-contradict", ())
    other = "disc" if first == "plate" else "plate"
    ratio = times if first == "plate" else 1.0 / times
    assert f"the masses of {first} and {other} contradict each other" in found.found
    said = float(found.found.split(f"{first} is ")[1].split(" ±")[0])
    assert said == pytest.approx(ratio, rel=0.05)


@pytest.mark.slow
def test_masses_that_leave_no_scale_are_refused_by_the_same_name() -> None:
    plate_kg = 3.0 * DECLARED_KG
    with pytest.raises(
        MassesContradict,
        match=r"by the torques plate is 2\.9\d ± .* times as "
        r"heavy beside disc",
    ):
        diagnosed(TRUTH, recordings(plate_kg))


@pytest.mark.slow
def test_another_body_in_one_run_is_no_contradiction_of_masses() -> None:
    """Two runs carry the disc, and the moves of one of them deny it."""
    bodies = {3: 0.7 * BODY, 7: BODY * (DECLARED_KG / BODY[-1])}
    runs = small_recordings(TRUTH, 0, count=8, bodies=bodies)
    changed_run = replace(runs[7], payload=PLATE)
    used = [*runs[:7], changed_run]
    (found,) = of_payloads(used)
    assert (found.name, found.runs) == ("payload-differs", ("r3",))


def test_a_run_without_load_is_not_blamed_for_another_body_in_a_loaded_run() -> None:
    bodies = {3: 0.7 * BODY}
    runs = small_recordings(TRUTH, 1, count=6, bodies=bodies)
    (found,) = of_payloads(runs)
    assert found.runs == ("r3",)
