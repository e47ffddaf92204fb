"""The gate of the controller's file: it is still the one that was there when the logs were recorded, or looked at."""

from __future__ import annotations

from daq.write_back.gates import Gate, Refusal
from ident.calibration import Calibration


def base_refusals(calibration: Calibration, file: str, base_sha256: str, looked_at: str | None) -> tuple[Refusal, ...]:
    """Closed where somebody has changed the file and nobody has looked at it since.

    Args:
        calibration: whose logs may tell the digest of the file at their time.
        file: what to call the controller's file.
        base_sha256: of its content now.
        looked_at: digest of the content that somebody has looked at, in a dry run; it outweighs the logs'.
    """
    if looked_at is not None:
        if looked_at == base_sha256:
            return ()
        return (
            Refusal(
                Gate.BASE,
                file,
                f"content {base_sha256[:12]}…",
                f"{looked_at[:12]}…, as --base says",
                "the file was changed since that look: take a new dry run, without --base",
            ),
        )
    logged = [(one.name, one.recording.controller_sha256) for one in calibration.sources if one.recording is not None]
    others = [(name, digest) for name, digest in logged if digest is not None and digest != base_sha256]
    return tuple(
        Refusal(
            Gate.BASE,
            file,
            f"content {base_sha256[:12]}…",
            f"{digest[:12]}…, as when {name} was recorded",
            "the file was changed since, by hand or by an earlier write: look at its gains and at the diff of this dry "
            f"run, and where both are as they should be, repeat it with --base {base_sha256}",
        )
        for name, digest in others[:1]
    )
