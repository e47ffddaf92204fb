"""Who runs the program is not what the environment says."""

from __future__ import annotations

import os
import pwd

import pytest

from daq.cli.apply import applier
from daq.environment import login


@pytest.mark.parametrize("variable", ["LOGNAME", "USER", "LNAME", "USERNAME"])
def test_a_name_of_one_s_own_choice_is_not_an_exception(
    monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, "carol")
    assert login() == pwd.getpwuid(os.getuid()).pw_name
    names = applier("Ada").names
    assert names == ("Ada", login())


def test_a_user_without_a_name_has_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_one(_number: int) -> pwd.struct_passwd:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", no_one)
    assert login() == f"uid {os.getuid()}"
