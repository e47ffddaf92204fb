"""`python -m daq` is `drivegain`."""

from __future__ import annotations

import sys

from daq.cli.app import main

sys.exit(main())
