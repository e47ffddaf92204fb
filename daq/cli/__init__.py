"""The command `drivegain`."""

import os
import sys
from collections.abc import Sequence

from daq.cli.output import write_if_taken
from lazy_names import shadowed_package

# More threads make linear algebra of this size slower and take several times the processor time.
# The libraries read the variable when they are loaded; a value from the environment is kept.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# pydantic reads the metadata of every installed package in search of plugins; there are none for
# us.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; see `daq.cli.app.main`.

    Ctrl-C while the command is imported is no traceback.
    """
    try:
        try:
            from daq.cli.app import main as run
        except ImportError:
            found = shadowed_package()
            if not found:
                raise
            sys.stderr.write(f"error: {found}\n")
            return 6  # ExitCode.CONFIGURATION, which cannot be imported then

        return run(arguments)
    except KeyboardInterrupt:
        write_if_taken("interrupted\n")
        return 130  # ExitCode.INTERRUPTED, which may not be imported yet
