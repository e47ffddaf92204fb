"""Live displays of rich that draw nothing while the terminal does not take what they have drawn."""

from __future__ import annotations

from rich.live import Live
from rich.progress import Progress

from daq.cli.output import is_behind


class PatientLive(Live):
    """Live display that leaves out frames rather than let them queue up for a stopped terminal."""

    def refresh(self) -> None:
        """Draw a frame, if the earlier ones have been taken."""
        if not is_behind(self.console.file):
            super().refresh()


class PatientProgress(Progress):
    """Progress bars on a `PatientLive`."""

    def __init__(self, *columns: object, **options: object) -> None:
        """Take the arguments of `Progress`, which does not let its display be chosen."""
        super().__init__(*columns, **options)  # type: ignore[arg-type]
        self.live = PatientLive(
            console=self.live.console,
            refresh_per_second=self.live.refresh_per_second,
            get_renderable=self.get_renderable,
        )
