"""What the machine takes from the programs on it, tick by tick, in files.

    python host_watch.py FILE CPU     (writes "ready" when it watches; SIGTERM or the end of its input ends it)

One process watches on each processor. It notes how late it woke, although it has the highest
priority, and how long a short piece of work took that is always the same: a virtual machine may run
at a fraction of its speed, and no counter of its kernel shows that. The process on the first
processor adds what the kernel counts: how long threads of the watched processes waited for a
processor (/proc/PID/task/TID/schedstat), processor time that the hypervisor took (steal of
/proc/stat), and packets of the network that were dropped because the queue of those received was
full (/proc/net/softnet_stat). Of the role "recorder" it notes besides for how long its busiest
thread ran, its major page faults, and whether a thread was waiting for a disk: they excuse nothing,
and tell what to look for. A line "ROLE PID" on its input adds a process.

It shares no code with the product. As a program it needs the standard library alone. A tick takes
less than 0.1 ms of a processor.
"""  # noqa: E501

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

TICK_NS = 2_500_000
LOOK_NS = 200_000_000  #: Time between two looks for new threads
WORK = tuple(range(300))  #: A piece of work, some 20 us
RECORD = struct.Struct("=qqqqqqqqqqq")
EXPLAINED = "recorder"  #: Role of which more is noted
STEAL = 8  #: Place of the stolen time among the words of /proc/stat (proc_stat(5))
STATE = 0  #: Place behind the name in /proc/PID/stat (proc_pid_stat(5))
MAJOR_FAULTS = 9
DROPPED = 1  #: Column of /proc/net/softnet_stat
STEAL_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")


class Tick(NamedTuple):
    """The counts of one tick on one processor."""

    time_ns: int  #: wall time [ns since 1970]
    since_ns: int  #: since the tick before [ns]
    late_ns: int  #: by which the sleeper woke late [ns]
    work_ns: int  #: time of the same short piece of work [ns]
    waited_ns: int  #: sum of the processes' waiting times, of each its longest thread's [ns]
    stolen_ns: int  #: by the hypervisor, of all processors, in whole ticks of the kernel's [ns]
    dropped: int  #: packets, because a queue of the kernel was full
    cpu: int  #: number of the processor
    ran_ns: int = 0  #: by the recorder's busiest thread [ns]
    major_faults: int = 0  #: of the recorder's threads: pages that were read from a disk
    disk_waits: int = 0  #: threads of the recorder in an uninterruptible wait at this tick


@dataclass
class Watch:
    """A watch that runs."""

    commands: IO[str]  #: its input

    def add(self, role: str, pid: int) -> None:
        """Watch a process too, with all its threads and children."""
        self.commands.write(f"{role} {pid}\n")
        self.commands.flush()


@contextmanager
def watching(path: Path) -> Iterator[Watch]:
    """Watch in processes of their own until the block ends; the files are complete then."""
    with ExitStack() as stack:
        watches = [
            stack.enter_context(_watching(path, cpu)) for cpu in sorted(os.sched_getaffinity(0))
        ]
        yield watches[0]


@contextmanager
def _watching(path: Path, cpu: int) -> Iterator[Watch]:
    command = [sys.executable, "-I", "-S", str(Path(__file__).resolve()), str(path), str(cpu)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            if process.stdout is None or process.stdin is None:
                raise RuntimeError("nothing watches the machine")
            if process.stdout.readline() != "ready\n":
                raise RuntimeError("nothing watches the machine")
            yield Watch(process.stdin)
        finally:
            process.terminate()
            if process.wait(timeout=60) != 0:
                raise RuntimeError(f"the watch ended with {process.returncode}")


def watched(path: Path) -> list[Tick]:
    """Return the ticks of a watch, of all processors, by processor and time."""
    ticks = []
    for file in sorted(path.parent.glob(f"{path.name}.*")):
        data = file.read_bytes()
        whole = data[: len(data) // RECORD.size * RECORD.size]
        ticks += [Tick(*numbers) for numbers in RECORD.iter_unpack(whole)]
    return ticks


# -- the program
# ------------------------------------------------------------------------------------------------


@dataclass
class _Role:
    """Processes of one role, and what each of their threads has had up to the last tick."""

    pids: set[int] = field(default_factory=set)
    files: dict[int, int] = field(default_factory=dict)  #: descriptor of schedstat by thread
    stat_files: dict[int, int] = field(default_factory=dict)  #: descriptor of stat by thread
    ran_ns: dict[int, int] = field(default_factory=dict)  #: by thread
    waited_ns: dict[int, int] = field(default_factory=dict)  #: by thread
    faults: dict[int, int] = field(default_factory=dict)  #: by thread

    def look(self) -> None:
        """Find the threads that there are now, also those of children."""
        found: set[int] = set()
        open_pids = list(self.pids)
        while open_pids:
            tasks = Path(f"/proc/{open_pids.pop()}/task")
            with suppress(OSError):
                for task in tasks.iterdir():
                    found.add(int(task.name))
                    children = (task / "children").read_text(encoding="ascii")
                    open_pids += [int(word) for word in children.split()]
        for thread in found - self.files.keys():
            with suppress(OSError):
                self.files[thread] = os.open(f"/proc/{thread}/schedstat", os.O_RDONLY)
                self.stat_files[thread] = os.open(f"/proc/{thread}/stat", os.O_RDONLY)
        for thread in self.files.keys() - found:
            os.close(self.files.pop(thread))
            if thread in self.stat_files:
                os.close(self.stat_files.pop(thread))
            for counts in (self.ran_ns, self.waited_ns, self.faults):
                counts.pop(thread, None)

    def growth_ns(self) -> tuple[int, int]:
        """Return the longest times that one of its threads waited, and ran, since the last tick
        [ns].
        """
        longest_ns = 0
        busiest_ns = 0
        for thread, descriptor in self.files.items():
            try:
                words = os.pread(descriptor, 80, 0).split()
            except OSError:  # it has ended
                continue
            waited_ns = int(words[1])
            before_ns = self.waited_ns.get(thread, waited_ns)
            longest_ns = max(longest_ns, waited_ns - before_ns)
            self.waited_ns[thread] = waited_ns
            ran_ns = int(words[0])
            busiest_ns = max(busiest_ns, ran_ns - self.ran_ns.get(thread, ran_ns))
            self.ran_ns[thread] = ran_ns
        return longest_ns, busiest_ns

    def disk(self) -> tuple[int, int]:
        """Return its major page faults since the last tick, and its threads that wait for a disk
        now.
        """
        faults = 0
        waiting = 0
        for thread, descriptor in self.stat_files.items():
            try:
                text = os.pread(descriptor, 1000, 0)
            except OSError:  # it has ended
                continue
            # The name of the program, in brackets, may have spaces.
            words = text[text.rfind(b")") + 1 :].split()
            waiting += words[STATE] == b"D"
            count = int(words[MAJOR_FAULTS])
            faults += count - self.faults.get(thread, count)
            self.faults[thread] = count
        return faults, waiting


def _stolen_ns() -> int:
    with open("/proc/stat", encoding="ascii") as file:  # noqa: PTH123 - a tick must be short
        return int(file.readline().split()[STEAL]) * STEAL_NS


def _dropped() -> int:
    with open("/proc/net/softnet_stat", encoding="ascii") as file:  # noqa: PTH123
        return sum(int(line.split()[DROPPED], 16) for line in file)


def _work() -> int:
    """Do the piece of work; return its time [ns]."""
    begun_ns = time.monotonic_ns()
    total = 0
    for number in WORK:
        total += number
    return time.monotonic_ns() - begun_ns


def main(path: str, cpu: str) -> None:
    """Watch until SIGTERM, or until nobody is left to give commands."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.sched_setaffinity(0, {int(cpu)})
    with suppress(PermissionError):  # without it, the sleeper waits as other programs do
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(2))
    roles: dict[str, _Role] = {}
    commands = _Commands()
    stolen_ns = _stolen_ns()
    dropped = _dropped()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    last_ns = time.monotonic_ns()
    due_ns = last_ns + TICK_NS
    look_ns = last_ns
    with Path(f"{path}.{cpu}").open("wb") as file:
        while not ended and not commands.ended:
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            now_ns = time.monotonic_ns()
            wall_ns = time.time_ns()
            late_ns = max(0, now_ns - due_ns)
            work_ns = _work()
            if commands.read_into(roles) or now_ns >= look_ns:
                look_ns = now_ns + LOOK_NS
                for role in roles.values():
                    role.look()
                file.flush()
            waited_ns = 0
            ran_ns = 0
            for name, role in roles.items():
                role_waited_ns, role_ran_ns = role.growth_ns()
                waited_ns += role_waited_ns
                if name == EXPLAINED:
                    ran_ns = role_ran_ns
            major_faults = 0
            disk_waits = 0
            if EXPLAINED in roles:
                major_faults, disk_waits = roles[EXPLAINED].disk()
            now_stolen_ns = stolen_ns
            now_dropped = dropped
            if roles:  # another process of the watch has none, and leaves the counts to this one
                now_stolen_ns = _stolen_ns()
                now_dropped = _dropped()
            tick = Tick(
                wall_ns,
                now_ns - last_ns,
                late_ns,
                work_ns,
                waited_ns,
                now_stolen_ns - stolen_ns,
                now_dropped - dropped,
                int(cpu),
                ran_ns,
                major_faults,
                disk_waits,
            )
            file.write(RECORD.pack(*tick))
            stolen_ns = now_stolen_ns
            dropped = now_dropped
            last_ns = now_ns
            due_ns = max(due_ns + TICK_NS, now_ns)


class _Commands:
    """Lines on the input, read without waiting."""

    def __init__(self) -> None:
        self.ended = False  #: whether nobody writes any more
        self._rest = b""
        os.set_blocking(0, False)

    def read_into(self, roles: dict[str, _Role]) -> bool:
        """Add the processes of the lines that wait; return whether there were any."""
        try:
            chunk = os.read(0, 4096)
        except BlockingIOError:
            return False
        self.ended = not chunk
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        for line in lines:
            role, pid = line.decode("ascii").split()
            roles.setdefault(role, _Role()).pids.add(int(pid))
        return bool(lines)


if __name__ == "__main__":
    main(*sys.argv[1:])
