"""What the data of a fit cannot tell, and by what they tell each gain, in words."""

from __future__ import annotations

from typing import Any

from daq.fit import DOUBTFUL_PERCENT, Fit
from ident.verdict import GOOD_PERCENT, GainVerdict


def cannot_tell(fitted: Fit) -> tuple[str, ...]:
    """What no residual of these data could show, in words."""
    if fitted.final.estimate.gains_fixed:
        return ()
    mounted = {payload.mounting for payload in fitted.identification.system.payloads}
    known = [payload for payload in fitted.cell.payloads if payload.payload.mounting in mounted]
    scales = [
        f"{payload.name} was weighed to {payload.mass_kg:g} kg ± {payload.mass_tolerance_kg:g} kg, which is "
        f"± {100.0 * payload.mass_tolerance_kg / payload.mass_kg:.2g} % of every gain, not in σ"
        for payload in known
        if payload.mass_tolerance_kg > 0.0
    ]
    drawn = [payload.name for payload in fitted.identification.system.payloads if len(payload.known) > 1]
    return (
        *(
            (
                f"Of {', '.join(drawn)} more than the mass is taken as exact. A drawing that is off by some per cent "
                "moves the gains by as much, and no σ says so: compare with --known mass, the better in the paper.",
            )
            if drawn
            else ()
        ),
        "What these data cannot tell: a wrong payload mass scales all gains alike and leaves no residual"
        + (f" ({'; '.join(scales)}); " if scales else "; ")
        + "so does a wrong value of gravity; a gear efficiency that is the same in "
        "both directions is part of its gain.",
    )


def advice(fitted: Fit, judged: tuple[GainVerdict, ...]) -> tuple[str, ...]:
    """By what each gain is seen and what would help, where one is known worse than to a per cent."""
    if fitted.final.estimate.gains_fixed:
        return ()
    error = fitted.final.training_error.total
    if error > DOUBTFUL_PERCENT:
        return (
            f"DOUBTFUL: the model leaves {error:.3g} % of the torque, expected some 3 to 15 %. No σ tells how wrong "
            "the gains are then: channels, signs, drive train, gravity or payload are not as the cell file says.",
        )
    if not judged:
        return (f"Excitation: every gain is known to {GOOD_PERCENT:g} % or better.",)
    return ("Excitation:", *(f"  {gain.words(fitted.cell.axis_names[gain.axis])}" for gain in judged))


def verdict_document(gain: GainVerdict, axes: tuple[str, ...]) -> dict[str, Any]:
    """One gain's verdict, for --json."""
    return {
        "axis": axes[gain.axis],
        "std_percent": gain.std_percent,
        "verdict": gain.verdict.value,
        "seen_by": [source.value for source in gain.sources],
        "words": gain.words(axes[gain.axis]),
    }
