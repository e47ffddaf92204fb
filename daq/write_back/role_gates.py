"""Gates of the logs together: what each was used for, and whether all of them can tell what is said of them."""

from __future__ import annotations

from collections.abc import Iterator

from daq.write_back.gates import Gate, Refusal
from ident.calibration import Calibration

_FIT, _HOLDOUT = "fit", "holdout"


def role_refusals(calibration: Calibration) -> Iterator[Refusal]:
    """Closed where the roles of the logs do not bear what the calibration says.

    Args:
        calibration: to be written, with at least one log.
    """
    sources = calibration.sources
    for source in sources:
        if source.role not in {_FIT, _HOLDOUT}:
            yield Refusal(
                Gate.SOURCES,
                f"log {source.name}",
                f"the role {source.role!r}",
                f"{_FIT!r} or {_HOLDOUT!r}",
                "fit the logs again",
            )
    fitted = [source for source in sources if source.role == _FIT]
    held = [source for source in sources if source.role == _HOLDOUT]
    if not fitted:
        yield Refusal(Gate.SOURCES, "calibration", "no log that was fitted", "at least one", "fit the logs again")
    elif not any(source.payload for source in fitted):
        yield Refusal(
            Gate.SOURCES,
            "calibration",
            "no payload in any log that was fitted",
            "one with a weighed payload, which sets the scale of the gains",
            "fit a loaded run too",
        )
    elif len(fitted) < 2:
        yield Refusal(
            Gate.SOURCES,
            "calibration",
            "one log that was fitted",
            "one without load and one with a weighed payload, or more",
            "fit both",
        )
    yield from _repeated(calibration)
    yield from _figures(calibration, bool(held))


def _repeated(calibration: Calibration) -> Iterator[Refusal]:
    """A log that was held out of nothing, or counts twice."""
    met: dict[str, str] = {}
    for source in calibration.sources:
        if source.sha256 in met:
            yield Refusal(
                Gate.SOURCES,
                f"log {source.name}",
                f"the same recording as log {met[source.sha256]}",
                "every recording once, in the fit or held out",
                "fit the logs again, each once",
            )
        met.setdefault(source.sha256, source.name)


def _figures(calibration: Calibration, held_out: bool) -> Iterator[Refusal]:
    """A figure without a log is nobody's; a log without its figure hides one."""
    told = calibration.holdout_error_percent is not None
    if told != held_out:
        yield Refusal(
            Gate.HOLDOUT,
            "calibration",
            "an error on held-out data, and no log of them" if told else "a log that was held out, and no error on it",
            "both or neither",
            "fit the logs again",
        )
