"""`import drivers` is enough: every name that it exports can be loaded."""

from __future__ import annotations

import drivers


def test_every_exported_name_loads() -> None:
    for name in drivers.__all__:
        assert getattr(drivers, name) is not None
    assert set(drivers.__all__) <= set(dir(drivers))
