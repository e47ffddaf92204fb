"""The controller's YAML file on the disk:
only the numbers meant change, whatever a human has made of the rest.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.formats.scalar import spell
from daq.ledger.audit import AuditAction, read
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose
from ident.calibration import Gain
from tests.daq.calibrations import demo_calibration, of_first_axes
from tests.daq.formats.yaml_cases import Case, cases


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(cases(), st.data())
def test_of_a_file_on_the_disk_nothing_but_the_gains_changes(
    case: Case, data: st.DataObject
) -> None:
    """The whole way, with lock, audit, backup and rename; and the bytes in the file afterwards."""
    axes = [f"J{number + 1}" for number in range(len(case.keys))]
    olds = [float(number) for number in case.numbers]
    shares = data.draw(st.lists(st.floats(0.7, 1.3), min_size=len(axes), max_size=len(axes)))
    gains = tuple(
        Gain(axis, share * old, 0.004 * abs(share * old), "Nm/A", old)
        for axis, share, old in zip(axes, shares, olds, strict=True)
    )
    spelt = tuple(
        text if float(reported := spell(gain.value, gain.std, text)) == float(text) else reported
        for gain, text in zip(gains, case.numbers, strict=True)
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.yaml"
        audit = Path(folder) / "audit.jsonl"
        file.write_bytes(case.text(case.numbers).encode())
        calibration = of_first_axes(replace(demo_calibration(), gains=gains), len(gains))
        keys = dict(zip(axes, case.keys, strict=True))
        # Its own file is not under test, and to spell it would take as long as all the rest.
        now = datetime(2025, 1, 2, tzinfo=UTC)
        request = Request(calibration, now, content=b"a calibration")
        target = FileTarget(file, keys)
        proposal = propose(target, request)
        assert proposal.refusals == ()
        written = apply(proposal, now, audit=audit, who="Ada")
        expected = case.text(spelt).encode()
        assert file.read_bytes() == expected
        if spelt != case.numbers:
            assert written is not None
            assert written.backup is not None
            assert written.backup.read_bytes() == case.text(case.numbers).encode()
            actions = [entry.action for entry in read(audit)]
            assert actions == [
                AuditAction.APPLY_BEGUN,
                AuditAction.APPLIED,
            ]
