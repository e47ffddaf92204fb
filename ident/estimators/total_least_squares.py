"""Total least squares: the paper's IDIM-TLS (eqs. 17-23)."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ident.estimate import Estimate, Method
from ident.system import System, require_known_payload
from ident.triangles import Triangles, solve

FloatArray = NDArray[np.float64]


class Scaling(Enum):
    """TLS is not invariant to scale, so the scale is a choice that is said."""

    NONE = "none"
    ROWS = "rows weighted per joint"  # the paper, §3.3
    COLUMNS = "unit-norm columns"
    BOTH = "rows weighted per joint, unit-norm columns"


def tls(system: System, scaling: Scaling = Scaling.ROWS) -> Estimate:
    """The right singular vector of W_tot's smallest singular value, scaled so that its last entry is one (eq. 18).

    Args:
        system: of at least one loaded and one unloaded run.
        scaling: of rows and columns before the decomposition; the paper weights rows per joint.

    Raises:
        DataUnfit: no run carries a known payload.
    """
    require_known_payload(system)
    triangles = system.joints
    weight = np.ones(system.joint_count)
    columns = scaling in (Scaling.COLUMNS, Scaling.BOTH)
    if scaling in (Scaling.ROWS, Scaling.BOTH):
        first, _, _ = _smallest(triangles, weight, columns)
        # σ_W^j, the standard deviation of joint j's equations (§3.3, last paragraph).
        weight = 1.0 / triangles.residual_std(first, len(first) - 1)
    vector, covariance, singular = _smallest(triangles, weight, columns)
    count = system.joint_count
    weighted = triangles.weighted_system(vector, len(vector) - 1, gains=True)
    return Estimate(
        method=Method.TLS,
        gains=vector[:count],
        gains_fixed=False,
        unknowns=system.unknowns,
        parameters=vector[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(vector, len(vector) - 1),
        singular_values=singular,
        condition=float(weighted[0] / weighted[-1]),
        rows=int(triangles.rows.sum()),
    )


def _smallest(
    triangles: Triangles, weight: FloatArray, unit_columns: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    stacked = triangles.stacked(weight)
    norms = np.linalg.norm(stacked, axis=0) if unit_columns else np.ones(stacked.shape[1])
    scaled = stacked / norms
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    vector = vt[-1] / vt[-1, -1]
    rows, unknowns = int(triangles.rows.sum()), len(vector)
    noise = s[-1] / np.sqrt(max(rows - unknowns, 1))  # eq. (22)
    compatible = scaled - s[-1] * np.outer(u[:, -1], vt[-1])  # eq. (20)
    first = compatible[:, :-1]
    size = 1.0 + float(np.sum(vector[:-1] ** 2))
    scaled_covariance = noise**2 * size * solve(first, scaled[:, -1])[1]  # eq. (23)
    back = norms[-1] / norms[:-1]
    return vector * norms[-1] / norms, scaled_covariance * np.outer(back, back), s
