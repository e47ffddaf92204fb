"""First process of the guest kernel that `tests.vcan.run` boots:
a root that forgets, vcan, the command, power off.

It runs by its path, before there is any environment, so it imports the standard library alone.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import termios
import traceback
import tty
from pathlib import Path
from typing import Any

MODULES = (
    "net/can/can",
    "net/can/can-raw",
    "net/can/can-bcm",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
    "fs/overlayfs/overlay",
)
"""In the order of what they need."""
CONSOLE = "/dev/tty1"
_FINIT_MODULE = 313  # asm/unistd_64.h; this kernel exists for x86-64 alone
_POWER_OFF = 0x4321FEDC  # linux/reboot.h
_LIBC = ctypes.CDLL(None, use_errno=True)


def main(folder: Path) -> None:
    """Do the job that the host has put down there."""
    job: dict[str, Any] = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    os.environ["PATH"] = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    _mount("proc", "/proc", "proc")
    _mount("sysfs", "/sys", "sysfs")
    for module in MODULES:
        _load(Path(job["modules"]) / f"{module}.ko")
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    for interface in job["interfaces"]:
        for command in (f"link add {interface} type vcan", f"link set {interface} up"):
            subprocess.run(["ip", *command.split()], check=True)
    _enter_root([str(folder), *([job["out"]] if job["out"] else [])])
    code = _run(job)
    (folder / "code").write_text(str(code), encoding="ascii")


def _enter_root(writable: list[str]) -> None:
    """The host's files, and above them a layer in memory that takes what is written."""
    _mount("tmpfs", "/mnt", "tmpfs", "size=80%")
    root = Path("/mnt/root")
    for name in ("upper", "work", "root"):
        Path("/mnt", name).mkdir()
    _mount("overlay", str(root), "overlay", "lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work")
    for kind, place in (("proc", "proc"), ("sysfs", "sys"), ("devtmpfs", "dev")):
        _mount(kind, str(root / place), kind)
    for kind, place in (("tmpfs", "dev/shm"), ("devpts", "dev/pts")):
        (root / place).mkdir(exist_ok=True)
        _mount(kind, str(root / place), kind)
    for folder in writable:
        target = root / folder.lstrip("/")
        target.mkdir(parents=True, exist_ok=True)
        _mount("hostfs", str(target), "hostfs", folder)
    os.chroot(root)
    os.chdir("/")


def _run(job: dict[str, Any]) -> int:
    console = os.open(CONSOLE, os.O_WRONLY | os.O_NOCTTY)
    tty.setraw(console)
    with Path(os.devnull).open("rb") as nothing:
        done = subprocess.run(
            job["command"],
            cwd=job["folder"],
            env=job["environment"],
            stdin=nothing,
            stdout=console,
            stderr=console,
            check=False,
        )
    termios.tcdrain(console)
    if done.returncode >= 0:
        return done.returncode
    return 128 - done.returncode


def _load(module: Path) -> None:
    with module.open("rb") as file:
        _done(_LIBC.syscall(_FINIT_MODULE, file.fileno(), b"", 0), f"loading {module}")


def _mount(source: str, target: str, kind: str, options: str = "") -> None:
    _done(
        _LIBC.mount(source.encode(), target.encode(), kind.encode(), 0, options.encode()),
        f"mounting {target}",
    )


def _done(result: int, what: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except BaseException:  # noqa: BLE001 - the end of the first process is the end of the kernel; say why
        traceback.print_exc()
    finally:
        os.sync()
        _LIBC.reboot(_POWER_OFF)
