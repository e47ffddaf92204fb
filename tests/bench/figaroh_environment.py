"""figaroh in an environment of its own, because it brings another Pinocchio than ours.

python -m tests.bench.figaroh_environment     makes it once, in out/bench-venv; `make figaroh`
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

FIGAROH = "figaroh==1.0.2"
FIGAROH_VENV = Path("out/bench-venv")  #: relative to the checkout
_STAMP = ".installed"


def figaroh_python() -> Path:
    """Return the interpreter of the environment, which is made where it is not there."""
    python = FIGAROH_VENV / "bin" / "python"
    if not has_figaroh(FIGAROH_VENV):
        sys.stdout.write(f"installing {FIGAROH} into {FIGAROH_VENV} (once)\n")
        sys.stdout.flush()
        subprocess.run(
            [sys.executable, "-m", "venv", "--without-pip", "--clear", str(FIGAROH_VENV)],
            check=True,
        )
        install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-qq", FIGAROH]
        subprocess.run(install, check=True)
        (FIGAROH_VENV / _STAMP).write_text(FIGAROH)
    return python


def has_figaroh(environment: Path) -> bool:
    """Whether the installation in an environment went to its end, with this version."""
    stamp = environment / _STAMP
    return stamp.exists() and stamp.read_text() == FIGAROH


if __name__ == "__main__":
    figaroh_python()
