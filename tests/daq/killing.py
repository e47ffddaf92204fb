"""A child process that is killed at a chosen system call, by a small tracer (Linux, ptrace(2))."""

from __future__ import annotations

import ctypes
import os
import signal
import warnings
from collections.abc import Callable
from typing import NoReturn

import pytest

_TRACEME = 0
_SYSCALL = 24
_SETOPTIONS = 0x4200
_TRACESYSGOOD = 0x1
_EXITKILL = 0x100000
_SYSCALL_STOP = signal.SIGTRAP | 0x80
_FAILED = 70
NOT_PERMITTED = 77  #: Exit code of a child that may not be traced

_ptrace = ctypes.CDLL(None, use_errno=True).ptrace
_ptrace.argtypes = (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p)
_ptrace.restype = ctypes.c_long


def in_a_child(work: Callable[[], int]) -> int:
    """Do some work in a process of its own, which ends with the code that it returns;
    return its process id.
    """
    with warnings.catch_warnings():
        # Of threads of the test runner, which the child never meets.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        code = _FAILED
        try:
            code = work()
        finally:
            os._exit(code)
    return child


def killed_where(here: Callable[[int], object], work: Callable[[], object]) -> bool:
    """Do some work in a child and kill it (SIGKILL) as it asks for a system call,
    which is not made any more.

    Args:
        here: of the call's number, from 1; where it returns true the child is killed. The child
            waits for the answer.
        work: with nothing left to import or to prepare; its calls and the child's own end are
            counted.

    Returns:
        whether it was killed; False where it was killed nowhere and came to its end.
    """
    child = os.fork()
    if child == 0:
        be_traced(work)
    _, status = os.waitpid(child, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) == NOT_PERMITTED:
        reason = "ptrace is not permitted here: no process can be killed at a chosen system call"
        # In CI a skip goes unread, so this test must not be skipped: it alone shows that no kill
        # leaves half a file.
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    try:
        ask_ptrace(_SETOPTIONS, child, _TRACESYSGOOD | _EXITKILL)
        stops = 0
        while True:
            ask_ptrace(_SYSCALL, child, 0)
            _, status = os.waitpid(child, 0)
            if not os.WIFSTOPPED(status):
                assert os.WIFEXITED(status)
                assert os.WEXITSTATUS(status) == 0, "the work itself failed"
                return False
            assert os.WSTOPSIG(status) == _SYSCALL_STOP
            stops += 1  # one as a call begins, one as it ends
            if stops % 2 and here(stops // 2 + 1):
                return True
    finally:
        if not os.WIFEXITED(status):
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def be_traced(work: Callable[[], object]) -> NoReturn:
    """Do some work in a child that was just forked, once its parent traces it;
    an integer is its exit code.
    """
    code = _FAILED
    try:
        if _ptrace(_TRACEME, 0, None, None) != 0:
            os._exit(NOT_PERMITTED)
        os.kill(os.getpid(), signal.SIGSTOP)
        found = work()
        code = found if isinstance(found, int) else 0
    finally:
        os._exit(code)


def ask_ptrace(request: int, child: int, data: int) -> None:
    """Make a request of ptrace(2).

    Raises:
        OSError: the kernel refuses it.
    """
    if _ptrace(request, child, None, data) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
