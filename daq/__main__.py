"""`python -m daq` is `drivegain`."""

from __future__ import annotations

import sys

from daq.cli import main

if __name__ == "__main__":
    sys.exit(main())
