"""Run the job on a schedule: a systemd service with its timer, or a line for cron."""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from daq.config.cell import Cell
from daq.config.recalibration import Recalibration
from daq.errors import ExitCode, UsageError
from daq.files import sha256

MARK = "# Made by `drivegain schedule`, which may replace this file."
"""First line of a unit that drivegain made."""
MARKS = (MARK, "# Made by `drivegain install-units`, which may replace this file.")
"""The same and that of earlier versions; a file of that name without one of them is not ours."""
#: Ends of the folders in which systemd finds units
_SEARCHED = (("systemd", "system"), ("systemd", "user"))
STOP_S = 30  #: Time for the axes to stop and the session to be saved, after SIGTERM [s]
CRON = {"hourly": "0 * * * *", "daily": "0 0 * * *", "weekly": "0 0 * * 1", "monthly": "0 0 1 * *"}
"""The dates of crontab(5) that systemd.time(7) means by a word:
`weekly` is Monday 00:00 for both.
"""
_NEEDS_LITTLE = """\
NoNewPrivileges=yes
ProtectSystem=full
ProtectHome=read-only
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectClock=yes
ProtectProc=invisible
ProtectHostname=yes
RestrictNamespaces=yes
RestrictSUIDSGID=yes
LockPersonality=yes
PrivateMounts=yes
PrivateDevices=yes
MemoryDenyWriteExecute=yes
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK AF_CAN
SystemCallArchitectures=native
# The capture may have the lowest real-time priority, by sched(7) without a capability.
LimitRTPRIO=1"""
#: Capabilities of a service of root: to keep the owner of a controller's file, and a receive buffer
#: beyond net.core.rmem_max, which loses no frame of the bus.
_CAPABILITIES = {"root": "CAP_CHOWN CAP_DAC_OVERRIDE CAP_FOWNER CAP_NET_ADMIN"}


@dataclass(frozen=True, slots=True)
class Unit:
    """A file for systemd: its name and its text."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Installation:
    """For whom the units are made."""

    cell_file: Path  #: absolute
    program: Path  #: path of `drivegain`, absolute
    schedule: str  #: calendar expression of systemd.time(7), such as weekly or `Sun 03:00`
    user: bool  #: whether it is a service of one user, and not of the system
    owner: str  #: of the cell file, in whose name the system's service runs


def units_of(cell: Cell, section: Recalibration, wanted: Installation) -> tuple[Unit, Unit]:
    """The service and its timer."""
    name = unit_name(cell)
    timer = f"""{MARK}
[Unit]
Description=drivegain: when cell {_plain(cell.name)} is recalibrated

[Timer]
OnCalendar={_plain(wanted.schedule)}
# A date that passed while the computer was off is not made up for when it is switched on: no robot moves because the
# power came back. The job's interlock would have to release it anyway.
Persistent=false
AccuracySec=1min

[Install]
WantedBy=timers.target
"""  # noqa: E501
    return Unit(f"{name}.service", _service(cell, section, wanted)), Unit(f"{name}.timer", timer)


def unit_name(cell: Cell) -> str:
    """Without its suffix; cells whose names differ in more than small letters,
    digits and hyphens get a digest too.
    """
    plain = re.sub(r"[^a-z0-9]+", "-", cell.name.lower()).strip("-")
    digest = ""
    if plain != cell.name:
        digest = "-" + sha256(cell.name.encode())[:6]
    return f"drivegain-recalibrate-{plain or 'cell'}{digest}"


def cron_line(wanted: Installation) -> str:
    """For `crontab -e`; cron mails what the job says on standard output.

    Raises:
        UsageError: the schedule is no word that cron has a line for.
    """
    when = CRON.get(wanted.schedule)
    if when is None:
        raise UsageError(
            f"--schedule {wanted.schedule}",
            found="a calendar expression of systemd",
            expected=f"with --cron one of {', '.join(CRON)}",
            remedy="choose one of them, and change the five fields in the line by hand",
        )
    command = " ".join(shlex.quote(part) for part in _command(wanted))
    return f"{when}  {command.replace('%', chr(92) + '%')}"  # a % ends a command of crontab(5)


def next_commands(wanted: Installation, timer: Unit, folder: Path) -> tuple[str, ...]:
    """Commands to type next."""
    systemctl = "systemctl"
    journal = "journalctl"
    verify = "systemd-analyze verify"
    if wanted.user:
        systemctl = "systemctl --user"
        journal = "journalctl --user"
        verify = "systemd-analyze --user verify"
    service = timer.name.removesuffix(".timer") + ".service"
    files = shlex.join(str(folder.absolute() / name) for name in (service, timer.name))
    timer_file = shlex.quote(str(folder / timer.name))
    link: tuple[str, ...] = ()
    if folder.parts[-2:] not in _SEARCHED:
        link = (f"{systemctl} link {files}",)
    return (
        f"{verify} {timer_file}",
        *link,
        f"{systemctl} daemon-reload",
        f"{systemctl} start {service}    # once, with an operator at the cell",
        f"{systemctl} enable --now {timer.name}",
        f"{systemctl} list-timers {timer.name}",
        f"{journal} -u {service} -o cat",
    )


def is_service_of(text: str, cell_file: Path) -> bool:
    """Return whether a service of ours runs the job of this cell file.

    Earlier versions wrote `--cell` before the file.
    """
    argument = " " + _quoted(str(cell_file))
    for line in text.splitlines():
        if line.startswith("ExecStart=") and line.endswith(argument):
            return True
    return False


def _command(wanted: Installation) -> tuple[str, ...]:
    return (str(wanted.program), "recalibrate", str(wanted.cell_file))


def _service(cell: Cell, section: Recalibration, wanted: Installation) -> str:
    command = " ".join(_quoted(part) for part in _command(wanted))
    seconds = round(60 * section.max_duration_min) + 2 * STOP_S
    # The lock of the bus is in a folder that all share, so the service must see the same /tmp and
    # /run.
    hardening = ""
    owner = ""
    writable = ""
    if not wanted.user:
        capabilities = _CAPABILITIES.get(wanted.owner, "")
        hardening = (
            f"\n# It reads its cell, writes next to it, and speaks CAN; no more.\n{_NEEDS_LITTLE}\n"
            f"CapabilityBoundingSet={capabilities}\n"
        )
        owner = (
            f"# Whose the cell file is: what the job writes stays theirs.\nUser={wanted.owner}\n"
        )
        writable = _writable(cell, section, wanted.cell_file)
    return f"""{MARK}
[Unit]
Description=drivegain: scheduled recalibration of cell {_plain(cell.name)}

[Service]
Type=oneshot
ExecStart={command}
{owner}WorkingDirectory={_plain(str(wanted.cell_file.parent))}
# 10: a change was found and waits for an operator. 11 to 14 (interlock, bus, time, held) fail the unit on purpose:
# OnFailure= may report it.
SuccessExitStatus={ExitCode.PROPOSED.value}
# No automatic restart: an operator decides.
Restart=no
# The job bounds its own time (max_duration_min) and stops the axes; this limit is longer.
TimeoutStartSec={seconds}
# SIGTERM stops the axes and writes the session down.
KillSignal=SIGTERM
KillMode=mixed
TimeoutStopSec={STOP_S}
Environment=OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
{hardening}{writable}"""  # noqa: E501


def _writable(cell: Cell, section: Recalibration, cell_file: Path) -> str:
    """Folders that ProtectHome= and ProtectSystem= would lock;
    of links, those where the files are.
    """
    folders = {cell_file.parent, section.folder.parent, section.folder}
    if cell.controller_path is not None:
        folders.add(Path(os.path.realpath(cell.controller_path)).parent)
    if cell.history is not None:
        folders |= {cell.history.store.parent, cell.history.audit.parent}
    if section.metrics is not None:
        folders.add(section.metrics)
    # "-": one that is not there yet must not keep the service from starting.
    # A path is no command line: here a $ is a $.
    lines = []
    for folder in sorted(folders):
        # A folder that is missing is no error, by its "-".
        path = _quoted(f"-{folder}", dollar="$")
        lines.append(f"ReadWritePaths={path}\n")
    return "".join(lines)


def _quoted(part: str, *, dollar: str = "$$") -> str:
    """An argument as systemd.service(5) reads it:
    % and $ doubled, in quotes where it needs them.
    """
    if not part.isprintable():
        raise UsageError(
            f"{part!r}",
            found="a control character in a path",
            expected="a path that fits in a line of a unit",
            remedy="rename the folder or file",
        )
    plain = _plain(part).replace("$", dollar)
    if re.fullmatch(r"[A-Za-z0-9_/.:=@%+-]+", plain):
        return plain
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain(text: str) -> str:
    """In one line, and no specifier of systemd (%)."""
    return "".join(letter if letter.isprintable() else " " for letter in text).replace("%", "%%")
