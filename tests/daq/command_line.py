"""The command line in this process."""

from daq.cli.app import main


def run_verb(*words: object) -> int:
    """Exit code of the command line with these words: a verb, its arguments and options."""
    return main([str(word) for word in words])
