"""Links of robots that a prior describes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.model.bodies import pseudo_inertia
from ident.physical.full_parameters import LinkPrior

FloatArray = NDArray[np.float64]


def drawn_links(prior: LinkPrior, rng: np.random.Generator) -> FloatArray:
    """Draw links, shape (n, 10); bodies that cannot exist are drawn again."""
    drawn: list[FloatArray] = []
    for link, directions in zip(prior.links, prior.directions(), strict=True):
        body = link + directions @ rng.standard_normal(10)
        while np.linalg.eigvalsh(pseudo_inertia(body))[0] <= 0.0:
            body = link + directions @ rng.standard_normal(10)
        drawn.append(body)
    return np.array(drawn)
