"""How well a fit has seen each gain, by what, and which moves would show it better."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from daq.conversion import load_run
from daq.errors import ConfigurationError
from daq.experiment import LAG_ONE, experiment_of
from daq.extra_moves import extra_moves
from daq.fit import Fit
from ident.dataset import differentiate
from ident.estimate import Method
from ident.excitation import Design, Excitation, Expectation, ExpectedPayload, effective_noise, recorded
from ident.identify import Identification
from ident.link import LINK_PARAMETERS
from ident.verdict import GOOD_PERCENT, ExtraMoves, GainVerdict, verdicts

FloatArray = NDArray[np.float64]


def gain_verdicts(fitted: Fit) -> tuple[GainVerdict, ...]:
    """Judge every gain of a fit with free gains; the logs are read again.

    The deviations are the fit's own, by moves left out in turn. What a way of seeing, or further moves, would give is
    scaled from the prediction as the fit's deviation is: moves tell of it, not the size of the noise.

    Args:
        fitted: effects, if it has any, are left out of the judgement.
    """
    found = fitted.identification
    estimate, system = found.estimate, found.system
    standard = np.zeros(len(found.model.columns))
    standard[list(system.base.independent)] = estimate.parameters[: len(system.base.independent)]
    # ml's noise is that of the current references, the others' that of the joint torques.
    noise = estimate.axis_noise / (1.0 if estimate.method is Method.ML else np.abs(estimate.gains))
    expectation = Expectation(
        model=found.model,
        gains=estimate.gains,
        parameters=standard,
        payloads=_payloads(found),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    design = Design(expectation, system.base)
    judged = verdicts(design, list(_excitations(fitted)), _extras(fitted))
    true = 100.0 * fitted.final.estimate.gains_std / np.abs(fitted.final.estimate.gains)
    return tuple(_scaled(gain, float(std)) for gain, std in zip(judged, true, strict=True))


def needed_verdicts(fitted: Fit) -> tuple[GainVerdict, ...]:
    """The verdicts, or none where the gains were given or all are known so well that nobody needs to ask by what."""
    estimate = fitted.final.estimate
    good = bool(np.all(100.0 * estimate.gains_std <= GOOD_PERCENT * np.abs(estimate.gains)))
    return () if good else gain_verdicts(fitted)


def _payloads(found: Identification) -> tuple[ExpectedPayload, ...]:
    first, payloads = len(found.system.columns), []
    for payload, indices in zip(found.system.payloads, found.system.payload_columns, strict=True):
        parameters = payload.known_parameters
        parameters[list(indices)] = found.estimate.parameters[first : first + len(indices)]
        first += len(indices)
        payloads.append(ExpectedPayload(frozenset(payload.known) & frozenset(LINK_PARAMETERS), parameters))
    return tuple(payloads)


def _excitations(fitted: Fit) -> Iterator[tuple[Excitation, tuple[int | None, ...]]]:
    found = fitted.identification
    mountings = [payload.mounting for payload in found.system.payloads]
    for log in fitted.logs:
        run, _ = load_run(log, fitted.cell, fitted.lossy)
        data = differentiate(run, found.model.drive_train, found.conditioning)
        mounted = None if run.payload is None else mountings.index(run.payload.mounting)
        yield recorded(found.model.drive_train, data, found.conditioning), (mounted,)


def _extras(fitted: Fit) -> tuple[ExtraMoves, ...]:
    """None where the cell does not say enough to plan moves in it."""
    try:
        return extra_moves(experiment_of(fitted.cell))
    except ConfigurationError:
        return ()


def _scaled(gain: GainVerdict, std_percent: float) -> GainVerdict:
    factor = std_percent / gain.std_percent if np.isfinite(gain.std_percent) and gain.std_percent else 1.0
    advice = gain.advice and replace(gain.advice, std_percent=factor * gain.advice.std_percent)
    alone = {source: factor * alone for source, alone in gain.alone_percent.items()}
    return replace(gain, std_percent=std_percent, alone_percent=alone, advice=advice)
