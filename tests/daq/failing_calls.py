"""A child process whose changing system calls are counted,
and one of which fails or is its end (Linux, ptrace(2)).

A changing call is one that changes what is on a disk: a file opened for writing, written, flushed,
renamed, linked, removed, its rights or its length changed, a folder made. The call that fails is
not made: the kernel gets the number of no call, and the process gets the error. So every library of
the process is reached, not Python's alone, and nothing is needed beside this module: neither strace
nor a compiler.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.daq.killing import NOT_PERMITTED, ask_ptrace, be_traced

_SYSCALL = 24
_GETREGS = 12
_SETREGS = 13
_SETOPTIONS = 0x4200
_TRACESYSGOOD = 0x1
_EXITKILL = 0x100000
_SYSCALL_STOP = signal.SIGTRAP | 0x80
_NO_CALL = 2**64 - 1
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_AT_CWD = -100

# Registers in the order of `struct user_regs_struct` (x86-64).
_R10 = 7
_R8 = 9
_RAX = 10
_RDX = 12
_RSI = 13
_RDI = 14
_ORIG_RAX = 15
_COUNT = 27


@dataclass(frozen=True, slots=True)
class CallKind:
    """One system call of the kernel.

    Attributes:
        name: what it does, as the tables of the study have it.
        path: index of the register with the path's address; None where it has none.
        folder: index of the register with the descriptor of the folder that a path is relative to.
        file: index of the register with the descriptor of the file.
        flags: index of the register with the flags of an open(2).
        size: index of the register with the number of bytes of a write.
    """

    name: str
    path: int | None = None
    folder: int | None = None
    file: int | None = None
    flags: int | None = None
    size: int | None = None


CALLS = {
    1: CallKind("write", file=_RDI, size=_RDX),
    18: CallKind("write", file=_RDI, size=_RDX),  # pwrite64
    20: CallKind("write", file=_RDI),  # writev
    296: CallKind("write", file=_RDI),  # pwritev
    40: CallKind("write", file=_RDI, size=_R10),  # sendfile
    326: CallKind("write", file=_RDX, size=_R8),  # copy_file_range
    3: CallKind("close", file=_RDI),
    2: CallKind("open", path=_RDI, flags=_RSI),
    257: CallKind("open", path=_RSI, folder=_RDI, flags=_RDX),
    85: CallKind("open", path=_RDI),  # creat
    74: CallKind("fsync", file=_RDI),
    75: CallKind("fsync", file=_RDI),  # fdatasync
    82: CallKind("rename", path=_RSI),
    264: CallKind("rename", path=_R10, folder=_RDX),
    316: CallKind("rename", path=_R10, folder=_RDX),
    86: CallKind("link", path=_RSI),
    265: CallKind("link", path=_R10, folder=_RDX),
    88: CallKind("link", path=_RSI),  # symlink
    266: CallKind("link", path=_RDX, folder=_RSI),
    87: CallKind("unlink", path=_RDI),
    263: CallKind("unlink", path=_RSI, folder=_RDI),
    84: CallKind("unlink", path=_RDI),  # rmdir
    83: CallKind("mkdir", path=_RDI),
    258: CallKind("mkdir", path=_RSI, folder=_RDI),
    90: CallKind("chmod", path=_RDI),
    91: CallKind("chmod", file=_RDI),
    268: CallKind("chmod", path=_RSI, folder=_RDI),
    92: CallKind("chown", path=_RDI),
    93: CallKind("chown", file=_RDI),
    94: CallKind("chown", path=_RDI),
    260: CallKind("chown", path=_RSI, folder=_RDI),
    44: CallKind("send", file=_RDI),  # sendto
    46: CallKind("send", file=_RDI),  # sendmsg
    76: CallKind("truncate", path=_RDI),
    77: CallKind("truncate", file=_RDI),
    285: CallKind("truncate", file=_RDI),  # fallocate
    188: CallKind("setxattr", path=_RDI),
    190: CallKind("setxattr", file=_RDI),
    199: CallKind("setxattr", file=_RDI),  # fremovexattr
    280: CallKind("utimens", path=_RSI, folder=_RDI),
}
"""Changing calls by their number on x86-64.

A close(2) may report that an earlier write failed (NFS, quotas). What is sent over a socket changes
no disk, but may change a drive.
"""
SOCKET = Path("/socket")  #: Path of what is sent


@dataclass(frozen=True, slots=True)
class Call:
    """A changing call that was asked for."""

    name: str  #: as in `CALLS`
    path: Path  #: file or folder that it changes
    size: int = 0  #: bytes that it is to write; 0 for another call, and for a writev(2)

    @property
    def is_change(self) -> bool:
        """Whether it changes a disk by itself; a close only reports on earlier writes."""
        return self.name != "close"


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens at one changing call.

    Attributes:
        number: of the call, from 0.
        error: number of the error that the call gives; None kills the process (SIGKILL) before the
            call is made.
        is_lasting: every later changing call gives the error too, or every later write takes at
            most `length` bytes.
        length: bytes that a write takes at most, as write(2) may: the call is made, gives their
            number, and leaves the rest to the caller. 0 where the fault is not a short write.
    """

    number: int
    error: int | None = None
    is_lasting: bool = False
    length: int = 0


@dataclass(frozen=True, slots=True)
class Traced:
    """How a child has ended.

    Attributes:
        code: its exit code; None where it was killed.
        calls: changing calls that it has asked for.
    """

    code: int | None
    calls: tuple[Call, ...]


def why_not_here() -> str:
    """Say why no call can be made to fail on this machine; empty where it can."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return (
            "the numbers and registers of system calls are those of Linux on x86-64, not of "
            f"{platform.machine()}"
        )
    code = traced(lambda: 0, lambda _: True).code
    if code == NOT_PERMITTED:
        return "ptrace is not permitted here: no system call can be made to fail"
    return ""


def traced(
    work: Callable[[], int], is_counted: Callable[[Path], bool], fault: Fault | None = None
) -> Traced:
    """Do some work in a child, with a fault at one of its changing calls.

    Args:
        work: returns the exit code. Calls of the threads and processes that it starts are left
            alone.
        is_counted: of the path that a call changes; other calls are not counted and never fail.
        fault: None for none.
    """
    with warnings.catch_warnings():
        # Of threads of the test runner, which the child never meets.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        be_traced(work)
    tracer = _Tracer(child, is_counted, fault)
    try:
        code = tracer.run()
    finally:
        tracer.end()
    return Traced(code, tuple(tracer.calls))


@dataclass(slots=True)
class _Tracer:
    """Follows the first thread of one child."""

    child: int
    is_counted: Callable[[Path], bool]
    fault: Fault | None
    calls: list[Call] = field(default_factory=list)
    is_ended: bool = False
    is_within: bool = False  #: between the begin and the end of a call
    instead: int | None = None  #: value that the present call is to give in place of its own

    def run(self) -> int | None:
        """Follow the child to its end; return its exit code, None where it was killed."""
        _, status = os.waitpid(self.child, 0)
        if os.WIFEXITED(status):
            self.is_ended = True
            return os.WEXITSTATUS(status)
        ask_ptrace(_SETOPTIONS, self.child, _TRACESYSGOOD | _EXITKILL)
        ask_ptrace(_SYSCALL, self.child, 0)
        while True:
            _, status = os.waitpid(self.child, 0)
            if not os.WIFSTOPPED(status):
                self.is_ended = True
                if os.WIFEXITED(status):
                    return os.WEXITSTATUS(status)
                return None
            passed_on = os.WSTOPSIG(status)
            if passed_on == _SYSCALL_STOP:
                passed_on = 0
                self._follow()
            with suppress(ProcessLookupError):  # it was killed just now
                ask_ptrace(_SYSCALL, self.child, passed_on)

    def end(self) -> None:
        """Kill a child that is still there."""
        if self.is_ended:
            return
        os.kill(self.child, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(self.child, 0)

    def _follow(self) -> None:
        """Take the begin or the end of a call."""
        registers = (ctypes.c_ulonglong * _COUNT)()
        ask_ptrace(_GETREGS, self.child, ctypes.addressof(registers))
        if self.is_within:
            self.is_within = False
            if self.instead is not None:
                registers[_RAX] = self.instead
                self.instead = None
                ask_ptrace(_SETREGS, self.child, ctypes.addressof(registers))
            return
        self.is_within = True
        call = self._changing(registers)
        if call is None:
            return
        number = len(self.calls)
        self.calls.append(call)
        fault = self.fault
        if fault is None or number < fault.number:
            return
        is_later = number > fault.number
        if is_later and not fault.is_lasting:
            return
        if fault.length:
            self._shorten(registers, fault.length)
            return
        if fault.error is None:
            os.kill(self.child, signal.SIGKILL)
            return
        self.instead = 2**64 - fault.error
        if call.is_change:  # the descriptor is closed, whatever close(2) says
            registers[_ORIG_RAX] = _NO_CALL
            ask_ptrace(_SETREGS, self.child, ctypes.addressof(registers))

    def _shorten(self, registers: ctypes.Array[ctypes.c_ulonglong], length: int) -> None:
        """Let the write that begins take no more than so many bytes."""
        size = CALLS[registers[_ORIG_RAX]].size
        if size is None or registers[size] <= length:
            return
        registers[size] = length
        ask_ptrace(_SETREGS, self.child, ctypes.addressof(registers))

    def _changing(self, registers: ctypes.Array[ctypes.c_ulonglong]) -> Call | None:
        """The changing call that begins; None for any other."""
        kind = CALLS.get(registers[_ORIG_RAX])
        if kind is None:
            return None
        if kind.flags is not None:
            flags = registers[kind.flags]
            if not flags & _WRITING:
                return None
        path = self._path_of(kind, registers)
        if path is None or not self.is_counted(path):
            return None
        size = 0
        if kind.size is not None:
            size = registers[kind.size]
        return Call(kind.name, path, size)

    def _path_of(self, kind: CallKind, registers: ctypes.Array[ctypes.c_ulonglong]) -> Path | None:
        process = Path(f"/proc/{self.child}")
        if kind.name == "send":
            return SOCKET
        if kind.file is not None:
            descriptor = str(registers[kind.file])
            info = process / "fdinfo" / descriptor
            if kind.name == "close" and not _is_for_writing(info):
                return None
            return _link(process / "fd" / descriptor)
        assert kind.path is not None
        if registers[kind.path] == 0:  # of the descriptor itself, as utimensat(2) has it
            return None
        memory = process / "mem"
        address = registers[kind.path]
        path = Path(_text(memory, address))
        folder = process / "cwd"
        if kind.folder is not None:
            number = ctypes.c_int(registers[kind.folder]).value
            if number != _AT_CWD:
                folder = process / "fd" / str(number)
        if path.is_absolute():
            return path
        return (_link(folder) or Path("/")) / path


def _is_for_writing(info: Path) -> bool:
    try:
        lines = info.read_text().splitlines()
    except OSError:
        return False
    of_flags = next(line for line in lines if line.startswith("flags:"))
    _, digits = of_flags.split()
    flags = int(digits, 8)
    return bool(flags & (os.O_WRONLY | os.O_RDWR))


def _link(path: Path) -> Path | None:
    """Where a descriptor leads; None for a pipe, a socket, or no descriptor."""
    try:
        target = path.readlink()
    except OSError:
        return None
    if target.is_absolute():
        return target
    return None


def _text(memory: Path, address: int) -> str:
    with memory.open("rb", buffering=0) as stream:
        stream.seek(address)
        content = b""
        while b"\0" not in content and len(content) < 4096:
            # Not beyond the page: the next one may not be there.
            place = address + len(content)
            content += stream.read(4096 - place % 4096)
    text, _, _ = content.partition(b"\0")
    return os.fsdecode(text)
