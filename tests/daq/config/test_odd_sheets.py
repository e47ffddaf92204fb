"""Data sheets that are odd as CiA 306 allows give the object dictionary that they were written
from.
"""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.daq.config.data_sheet import data_sheet
from tests.daq.config.odd_sheets import NODE_IDS, Entry, dictionaries, sheets


@pytest.mark.slow
@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_an_odd_sheet_gives_the_dictionary_that_it_was_written_from(data: st.DataObject) -> None:
    dictionary: dict[int, Entry] = data.draw(dictionaries())
    text = data.draw(sheets(dictionary))
    node_id = data.draw(NODE_IDS)
    encoded_text = text.encode("latin-1")
    found = data_sheet(encoded_text, "odd.eds", node_id)
    assert {index for index in found if index >= 0x1000} == set(dictionary)
    for index, entry in dictionary.items():
        for subindex, expected in entry.variables.items():
            variable = found.get_variable(index, subindex)
            assert variable is not None, f"{index:X}/{subindex}"
            assert variable.name == expected.name or not expected.name
            assert variable.data_type == expected.data_type
            assert variable.access_type == expected.access
            assert variable.pdo_mappable is expected.mappable
            default = expected.default
            if default is not None and expected.of_node:
                default += node_id
            assert variable.default == default
        for absent in set(range(1, 12)) - set(entry.variables):
            assert entry.object_type != 9 or found.get_variable(index, absent) is None
