"""Tasks of a study in several processes."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

Task = TypeVar("Task")
Made = TypeVar("Made")


class TaskFailed(RuntimeError):
    """A task failed in its process; the message is its traceback."""


@dataclass(frozen=True, slots=True)
class _Reporting(Generic[Task, Made]):
    """Errors with keyword arguments do not survive pickling, and a pool then waits for ever: they go over as text."""

    function: Callable[[Task], Made]

    def __call__(self, task: Task) -> tuple[Made | None, str]:
        try:
            return self.function(task), ""
        except Exception:  # noqa: BLE001 - passed whole to the calling process
            return None, f"{task}:\n{traceback.format_exc()}"


def side_by_side(function: Callable[[Task], Made], tasks: Iterable[Task], processes: int) -> Iterator[Made]:
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
