"""That somebody wants a calibration to be applied, and what they say of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from daq.calibration_file import encode
from daq.configuration.apply_policy import ApplyPolicy
from ident.calibration import Calibration


@dataclass(frozen=True, slots=True)
class Request:
    """The same for a controller's file and for the drives.

    Attributes:
        calibration: with the identified gains.
        now: for the age of the logs.
        policy: bounds; the cell's when None.
        configuration_changed: they have looked at what changed in the cell's configuration since the recording.
        entered_kg: masses that were read off the scale once more, by the payload's name [kg].
        looked_at: `Proposal.looked_at` of the change that they have looked at, or the digest of the controller file
            alone: then whatever the calibration changes in it.
        appliers: names of whoever applies it, the login last; their signatures do not count.
        file: of the calibration, where signatures are looked for; None where it is in no file.
        content: of that file, as it was read; None where it is in no file.
    """

    calibration: Calibration
    now: datetime
    policy: ApplyPolicy | None = None
    configuration_changed: bool = False
    entered_kg: Mapping[str, float] = field(default_factory=dict)
    looked_at: str | None = None
    appliers: Collection[str] = ()
    file: Path | None = None
    content: bytes | None = None

    @property
    def signed(self) -> bytes:
        """What a signature must be of."""
        return encode(self.calibration) if self.content is None else self.content
