"""Messages of the libraries on the command line:
verbs and options in the place of functions and arguments.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import pytest

from daq.advice import COMMANDS, for_command_line
from daq.cli.failure import ErrorParts
from drivers.canopen.emcy import remedy_of
from drivers.errors import NodeMisplaced, ParametersMixed
from ident.errors import EffectNotInstalled, NotConverged, PayloadMissing, PayloadUnseen
from ident.estimators.diagnosis import REMEDIES_OF_DISAGREEMENT
from ident.estimators.method import Method

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_name_of_the_table_is_in_a_message(name: str) -> None:
    files = chain((ROOT / "ident").rglob("*.py"), (ROOT / "drivers").rglob("*.py"))
    code = "".join(file.read_text() for file in files)
    assert name in code


def test_a_missing_payload_names_the_options_of_record_and_fit() -> None:
    assert ErrorParts.of(PayloadMissing(("bare",))).do == (
        "record one (`record --payload NAME --mass KG`), or hold the gains (`--gains fixed`)"
    )


def test_a_remedy_of_an_error_code_names_the_verb() -> None:
    said = for_command_line(remedy_of(0x8611))
    assert said.endswith("then reset the fault with `drivegain scan CELL --reset-faults`")


def test_estimators_that_disagree_name_method_and_residual() -> None:
    said = for_command_line(REMEDIES_OF_DISAGREEMENT[Method.TLS])
    assert said.startswith("use --method ml: ")
    assert said.endswith("; `drivegain residual` looks for effects")


def test_a_misplaced_node_names_the_scan() -> None:
    node_misplaced = NodeMisplaced(3, "can0", "can1")
    assert ("; `drivegain scan` shows the nodes of each bus") in ErrorParts.of(node_misplaced).error


def test_mixed_parameters_name_the_rollback() -> None:
    parameters_mixed = ParametersMixed(("J1",), ("J2: silent",))
    assert ("`drivegain rollback CELL --drives --yes`") in ErrorParts.of(parameters_mixed).do


def test_a_payload_that_is_not_seen_is_looked_for_in_every_run_before_a_heavier_one_is_advised() -> (  # noqa: E501
    None
):
    """A body that was mounted in the run without load hides it as well as a light one does."""
    payload_unseen = PayloadUnseen((40.0, 60.0), ("bare", "loaded"))
    remedy = ErrorParts.of(payload_unseen).do
    assert remedy.index("what was mounted in each run") < remedy.index("a heavier payload")


def test_no_verb_is_told_to_give_an_effect_as_an_argument() -> None:
    effect_not_installed = EffectNotInstalled("drag", "J2", "drags 0.2", installed="0.3")
    for error in (
        EffectNotInstalled("drag", "J2", "module drags"),
        effect_not_installed,
        EffectNotInstalled("drag", "J2", "drags 0.2", other="others 1.0"),
    ):
        assert "own_effects" in str(error)
        parts = ErrorParts.of(error)
        assert "own_effects" not in parts.do
        assert not parts.do.endswith((",", ", or"))


def test_a_fit_that_does_not_settle_names_no_function() -> None:
    error = NotConverged("ml", 27, (2.0, 1.0), 1e5)
    assert "`exchanged_channels`; look at `Run.payload` of each run" in str(error)
    said = ErrorParts.of(error).error
    assert "exchanged_channels" not in said
    assert "look at `drivegain info` of each log" in said
