"""Tasks of a study in several processes, and in shards that run apart."""

from __future__ import annotations

import argparse
import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Task = TypeVar("Task")
Made = TypeVar("Made")


class TaskFailed(RuntimeError):
    """A task failed in its process; the message is its traceback."""


@dataclass(frozen=True, slots=True)
class Shard:
    """Every `count`-th task of a study, from the `number`-th on (both from 1):
    shards together are the whole.
    """

    number: int = 1
    count: int = 1

    def of(self, tasks: Sequence[Task]) -> tuple[Task, ...]:
        """Return the tasks of this shard."""
        return tuple(tasks[self.number - 1 :: self.count])


def shard(text: str) -> Shard:
    """Read `i/n`, for the option `--shard`."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected i/n with i from 1 to n, as 2/4")
    return Shard(int(number), int(count))


@dataclass(frozen=True, slots=True)
class _Reporting(Generic[Task, Made]):
    """Errors with keyword arguments do not survive pickling, and a pool then waits for ever:
    they go over as text.
    """

    function: Callable[[Task], Made]

    def __call__(self, task: Task) -> tuple[Made | None, str]:
        try:
            return self.function(task), ""
        except Exception:  # noqa: BLE001 - passed whole to the calling process
            return None, f"{task}:\n{traceback.format_exc()}"


def side_by_side(
    function: Callable[[Task], Made], tasks: Iterable[Task], processes: int
) -> Iterator[Made]:
    """Yield the results of a function for each task, in the order of the tasks.

    Args:
        function: of a module, so that another process finds it; it makes something.
        tasks: that can be pickled.
        processes: as many at a time.

    Raises:
        TaskFailed: one of them raised; the rest is given up.
    """
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for made, trouble in pool.imap(_Reporting(function), tasks):
            if made is None:
                raise TaskFailed(trouble)
            yield made
