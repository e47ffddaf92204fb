"""Verbs and options of the command line, for the messages of `ident` and `drivers`.

These libraries know no command line: their messages name functions and arguments, in backticks. The
user of the command line reads the verb or option that does the same.
"""

from __future__ import annotations

COMMANDS = {
    "`find_effects`": "`drivegain residual`",
    "`fixed_gains`": "`--gains fixed`",
    '`method="ml"`': "--method ml",
    "test the order of the currents with `exchanged_channels`; ": "",  # each verb has done so
    " (`exchanged_channels` tests it)": "",
    # No verb takes an effect as an argument
    ", or give the effect to `load_calibration(path, own_effects=[...])`": "",
    "`Run.payload` of each run": "`drivegain info` of each log",
    "`Run.payload`": "`record --payload NAME --mass KG`",
    "`CanopenNetwork.reset_faults`": "`drivegain scan CELL --reset-faults`",
    "`drivers.scan`": "`drivegain scan`",
    "`Saving.RAM`": "--ram-only",
    "`Saving.ANY`": "--save-unknown",
}
"""What a function or an argument is called on the command line; the longer name comes first."""


def for_command_line(text: str) -> str:
    """Return a message with verbs and options in the place of functions and arguments."""
    for argument, command in COMMANDS.items():
        text = text.replace(argument, command)
    return text
