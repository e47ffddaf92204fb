"""Verdicts on the gains of a fit: which are known well enough,
and which moves or payloads would help.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from daq.errors import ConfigurationError
from daq.workflow.experiment import experiment_of, extra_moves
from daq.workflow.fit import Fit
from ident.data.dataset import differentiate
from ident.estimators.estimate import Identification
from ident.model.bodies import LINK_PARAMETERS
from ident.planning.excitation import (
    LAG_ONE,
    Design,
    Excitation,
    Expectation,
    ExpectedPayload,
    effective_noise,
    recorded,
)
from ident.planning.gain_verdict import GOOD_PERCENT, ExtraMoves, GainVerdict, verdicts


def design_after(found: Identification) -> Design:
    """Return the design of further recordings after a fit with free gains:
    its gains, parameters and noise.

    Effects are left out.
    """
    estimate = found.estimate
    system = found.system
    independent = list(system.base.independent)
    first = len(system.columns)
    standard = np.zeros(len(found.model.columns))
    standard[independent] = estimate.parameters[: len(independent)]
    payloads = []
    for payload, indices in zip(system.payloads, system.payload_columns, strict=True):
        parameters = payload.known_parameters
        parameters[list(indices)] = estimate.parameters[first : first + len(indices)]
        first += len(indices)
        known = frozenset(payload.known) & frozenset(LINK_PARAMETERS)
        payloads.append(ExpectedPayload(known, parameters))
    # ml's noise is that of the current references, the others' that of the joint torques.
    noise = estimate.axis_noise
    if not estimate.method.is_of_currents:
        noise = noise / np.abs(estimate.gains)
    expectation = Expectation(
        model=found.model,
        gains=estimate.gains,
        parameters=standard,
        payloads=tuple(payloads),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    return Design(expectation, system.base)


def gain_verdicts(fitted: Fit) -> tuple[GainVerdict, ...]:
    """Judge every gain of a fit with free gains, its effects left out; the logs are read again.

    σ is that of the fit, by leaving out moves. Predictions for one source alone, or with further
    moves, are multiplied by σ of the fit / predicted σ: a plan predicts ratios of σ well, but not
    the noise level.
    """
    extra: tuple[ExtraMoves, ...] = ()
    with suppress(ConfigurationError):  # the cell does not say enough to plan moves in it
        extra = extra_moves(experiment_of(fitted.cell))
    design = design_after(fitted.identification)
    judged = verdicts(design, list(excitations(fitted)), extra)
    estimate = fitted.estimate
    std_percent = 100.0 * estimate.gains_std / np.abs(estimate.gains)
    scaled = []
    for gain, std in zip(judged.gains, std_percent.tolist(), strict=True):
        scaled.append(_scaled(gain, std))
    return tuple(scaled)


def needed_verdicts(fitted: Fit) -> tuple[GainVerdict, ...]:
    """The verdicts, or none where the gains were given or all are known well enough."""
    estimate = fitted.estimate
    is_good = 100.0 * estimate.gains_std <= GOOD_PERCENT * np.abs(estimate.gains)
    if np.all(is_good):
        return ()
    return gain_verdicts(fitted)


def excitations(fitted: Fit) -> Iterator[tuple[Excitation, tuple[int | None, ...]]]:
    """Yield the motion of each log of a fit, with what was mounted; the logs are read again."""
    found = fitted.identification
    mountings = [payload.mounting for payload in found.system.payloads]
    for run in fitted.runs(fitted.logs):
        data = differentiate(run, found.model.drive_train, found.conditioning)
        if run.payload is None:
            mounted = None
        else:
            mounted = mountings.index(run.payload.mounting)
        yield recorded(found.model, data, found.conditioning), (mounted,)


def _scaled(gain: GainVerdict, std_percent: float) -> GainVerdict:
    factor = 1.0
    if np.isfinite(gain.std_percent) and gain.std_percent:
        factor = std_percent / gain.std_percent
    advice = gain.advice
    if advice is not None:
        advice = replace(advice, std_percent=factor * advice.std_percent)
    alone = {source: factor * alone for source, alone in gain.alone_percent.items()}
    known = gain.known_preload_percent and factor * gain.known_preload_percent
    return replace(
        gain,
        std_percent=std_percent,
        known_preload_percent=known,
        alone_percent=alone,
        advice=advice,
    )
