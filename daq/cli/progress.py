"""Progress of long work, on stderr: stdout is for results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

Told = Callable[[int, int, str], None]
"""Done, total, and a remark."""


class Stepper:
    """A bar for each of several steps, one after the other; a context manager."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("{task.fields[remark]}", style="dim"),
        )
        self._bars = Progress(*columns, console=Console(stderr=True), refresh_per_second=5)
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self._end()
        self._bars.stop()

    def step(self, title: str) -> None:
        """End the step before, and begin another."""
        self._end()
        self._task = self._bars.add_task(title, total=None, remark="")

    def progress(self, done: int, total: int, remark: str) -> None:
        """Within the step; a total of 0 is not known."""
        if self._task is not None:
            of = f"{done}/{total} " if total else ""
            self._bars.update(self._task, completed=done, total=total or None, remark=of + remark)

    def _end(self) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=1, total=1)
            self._bars.stop_task(self._task)


@contextmanager
def progress_bar(title: str) -> Iterator[Told]:
    """One bar."""
    with Stepper() as stepper:
        stepper.step(title)
        yield stepper.progress


@contextmanager
def status(title: str) -> Iterator[Callable[[str], None]]:
    """A spinner for work whose length nobody knows; every step it is told is a line."""
    console = Console(stderr=True, highlight=False)
    with console.status(title):

        def told(step: str) -> None:
            console.print(f"  {step}", style="dim")

        yield told
