"""Run a command where the kernel has vcan0 and vcan1:
here if this kernel can, else in a guest (User-Mode Linux).

    python -m tests.vcan.run COMMAND ...

In the guest the host's whole file system is there to read; what the command writes is forgotten,
except in the folder that DRIVEGAIN_VCAN_OUT names. Output and exit code are the command's own.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType

INTERFACE = "vcan0"
SECOND_INTERFACE = "vcan1"
OUT = "DRIVEGAIN_VCAN_OUT"
FAILED = 125
"""Exit code where the command could not be run at all."""
GUEST_MEMORY = "3G"
HIGHEST_PRIORITY = -20
PACKAGES = "apt-get install --no-install-recommends user-mode-linux iproute2"


def main(command: Sequence[str]) -> int:
    """Run it; the exit code."""
    if not command:
        print(__doc__, file=sys.stderr)  # noqa: T201
        return FAILED
    if (Path("/sys/class/net") / INTERFACE).exists():
        return subprocess.call(command)
    made = tuple(name for name in (INTERFACE, SECOND_INTERFACE) if _make_interface(name))
    if made:
        try:
            return subprocess.call(command)
        finally:
            for name in made:
                subprocess.call(["ip", "link", "delete", name])
    kernel = shutil.which("linux.uml")
    if kernel is None:
        return _say(f"this kernel has no vcan, and there is no linux.uml to bring one: {PACKAGES}")
    return _in_guest(kernel, command)


def _make_interface(name: str) -> bool:
    """Whether this kernel, and what we may do with it, gave us an interface of that name."""
    if shutil.which("ip") is None or os.geteuid() != 0:
        return False
    add = subprocess.run(
        ["ip", "link", "add", name, "type", "vcan"], capture_output=True, check=False
    )
    return add.returncode == 0 and subprocess.call(["ip", "link", "set", name, "up"]) == 0


def _in_guest(kernel: str, command: Sequence[str]) -> int:
    release = subprocess.run(
        [kernel, "--version"], capture_output=True, text=True, check=True
    ).stdout.strip()
    modules = Path("/usr/lib/uml/modules") / release / "kernel"
    if not modules.is_dir():
        return _say(f"no modules of {kernel} at {modules}: {PACKAGES}")
    with tempfile.TemporaryDirectory(prefix="drivegain-vcan-") as name:
        folder = Path(name)
        job = {
            "command": list(command),
            "folder": str(Path.cwd()),
            "environment": dict(os.environ),
            "modules": str(modules),
            "interfaces": [INTERFACE, SECOND_INTERFACE],
            "out": os.environ.get(OUT),
        }
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        _boot(kernel, folder)
        code = folder / "code"
        if code.exists():
            return int(code.read_text(encoding="ascii"))
        return _say(
            f"the guest ended before the command did; it said:\n{_tail(folder / 'console')}"
        )


def _boot(kernel: str, folder: Path) -> None:
    """Run the guest to its end; what it writes to its second console is ours."""
    guest = Path(__file__).with_name("guest.py")
    read_end, write_end = os.pipe()
    with (folder / "console").open("wb") as console:
        arguments = [
            kernel,
            f"mem={GUEST_MEMORY}",
            "root=/dev/root",
            "rootfstype=hostfs",
            "rootflags=/",
            "ro",
            "quiet",
            f"uml_dir={folder}/",
            "umid=guest",
            "con=null",
            f"con0=null,fd:{console.fileno()}",
            f"con1=null,fd:{write_end}",
            f"init={os.path.realpath(sys.executable)}",
            "--",
            str(guest),
            str(folder),
        ]
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=console,
            pass_fds=(console.fileno(), write_end),
            # Its memory is a file: in RAM where there is a place for that.
            env={
                **os.environ,
                "TMPDIR": "/dev/shm" if os.access("/dev/shm", os.W_OK) else tempfile.gettempdir(),
            },
            start_new_session=True,
        )
        # One processor is all that this kernel uses: changing it between system calls costs a third
        # of its speed.
        processors = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(process.pid, {processors[process.pid % len(processors)]})
        _go_first(process.pid)
        os.close(write_end)

        def end(number: int, _frame: FrameType | None) -> None:
            os.killpg(process.pid, signal.SIGKILL)
            raise SystemExit(128 + number)

        before = {
            number: signal.signal(number, end)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        }
        try:
            while data := os.read(read_end, 65536):
                sys.stdout.buffer.write(data)
                sys.stdout.flush()
            process.wait()
        finally:
            os.close(read_end)
            for number, handler in before.items():
                signal.signal(number, handler)


def _go_first(pid: int) -> None:
    """The guest's clock goes on while the host gives its time to others, and SYNC would come late:
    it goes first.

    Where we may ask for that. As a real-time process it would stand still for 50 ms of each second
    that it is busy (sched_rt_runtime_us), which is five cycles at 100 Hz; and a niceness counts
    within its own session alone, except where the session has one (autogroup).
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, HIGHEST_PRIORITY)
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(HIGHEST_PRIORITY), encoding="ascii")


def _tail(path: Path) -> str:
    return "\n".join(path.read_text(encoding="utf-8", errors="replace").splitlines()[-20:])


def _say(problem: str) -> int:
    print(f"tests.vcan.run: {problem}", file=sys.stderr)  # noqa: T201
    return FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
