"""The example streams from a simulated cell on a hub,
and the front door of `drivers` holds what it promises.
"""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import drivers
from daq.config.cell_buses import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.hub import Hub

SAMPLES = 50


def test_the_example_prints_samples_of_all_axes(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = runpy.run_path(str(checkout / "examples/stream_from_a_bus.py"))
    with Hub(("can0",)) as hub, open_bus(hub.address()) as bus:
        with SimulatedCell(
            load_simulation(checkout / "configs/simulation/clean.yaml"), bus
        ) as cell:
            address = str(hub.address())
            # In lockstep, so that a busy machine loses no sample; the script itself sends SYNC by
            # the clock.
            example["main"](address, drivers.LockstepSync(1_000_000, timeout_s=10.0), SAMPLES)
        assert cell.cycles >= SAMPLES
        assert not any(node.drive.powered for node in cell.nodes)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == SAMPLES + 1
    assert lines[SAMPLES - 1].startswith(f"{SAMPLES - 1} (")
    assert lines[SAMPLES - 1].count(" A") == 6
    assert lines[-1] == f"{6 * SAMPLES} frames, 0 missing"


def test_an_absent_bus_is_an_error_in_one_line(checkout: Path) -> None:
    command = [
        sys.executable,
        str(checkout / "examples/stream_from_a_bus.py"),
        "socketcand:can0@127.0.0.1:9",
    ]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=60, cwd=checkout
    )
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: bus socketcand:can0@127.0.0.1:9: ")
    assert len(ended.stderr.splitlines()) == 1


def test_without_an_address_the_example_says_how_one_looks(checkout: Path) -> None:
    command = [sys.executable, str(checkout / "examples/stream_from_a_bus.py")]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=60, cwd=checkout
    )
    assert ended.returncode == 1
    assert "socketcan:can0" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_every_name_of_the_front_door_is_there_and_nothing_is_loaded_before() -> None:
    for name in drivers.__all__:
        assert getattr(drivers, name).__module__.startswith("drivers.") or name == "CIA402"
    assert set(drivers.__all__) <= set(dir(drivers))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        drivers.nothing  # type: ignore[attr-defined]  # noqa: B018 - the access is the test
    loaded = (
        "import sys, drivers; print([name for name in sys.modules if name.startswith(('can', "
        "'numpy', 'drivers.'))])"
    )
    ended = subprocess.run(
        [sys.executable, "-c", loaded], capture_output=True, text=True, check=True
    )
    assert ended.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "text", ["socketcan:can0", "virtual:a b", "socketcand:can1@127.0.0.1:29536"]
)
def test_an_address_is_read_as_it_is_written(text: str) -> None:
    assert str(drivers.BusAddress.parse(text)) == text


@pytest.mark.parametrize("text", ["", "can0", "socketcand:can0@host", ":can0"])
def test_an_address_of_another_form_is_refused(text: str) -> None:
    with pytest.raises(drivers.BusError, match="expected INTERFACE:CHANNEL"):
        drivers.BusAddress.parse(text)


def test_the_standard_profile_is_that_of_the_shipped_file(checkout: Path) -> None:
    shipped = drive_axes(load_cell(checkout / "configs/cells/demo.yaml"))[0].profile
    facts = (
        "position",
        "current",
        "amplitude",
        "tap",
        "saturation_bit",
        "update_period_us",
        "rated",
        "toggle_bit",
    )
    for name in facts:
        assert getattr(drivers.CIA402, name) == getattr(shipped, name), name
    assert drivers.CIA402.current_scale.ampere_per_unit(
        [2000]
    ) == shipped.current_scale.ampere_per_unit([2000])
