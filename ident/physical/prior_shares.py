"""What each parameter of a chosen set of bodies rests on:
the base parameters of the fit, or the prior on the links.

`ident.physical.physical` takes, of all sets χ with the identified base parameters G χ = β̂, the one
nearest to the prior χ₀. To first order the distance is (χ − χ₀)ᵀ S⁻¹ (χ − χ₀), with S the
covariance of the prior; rotors, friction and offsets have none, S⁻¹ = 0. With the columns of N a
basis of the null space of G, the choice is linear,

    χ = A β̂ + B χ₀,    B = N (Nᵀ S⁻¹ N)⁻¹ Nᵀ S⁻¹,    A = (1 − B) G⁺,

and its errors are those of the data and those of the prior,

    cov χ = A C Aᵀ + N (Nᵀ S⁻¹ N)⁻¹ Nᵀ.

The share of the second part in the variance of a parameter says what it rests on, as in
`ident.physical.full_parameters`.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.model.model import Model
from ident.physical.full_parameters import LinkPrior

_LOOSE = 1e-10  #: Singular value, relative to the largest, that counts as zero


def prior_shares(
    model: Model, grouping: FloatArray, covariance: FloatArray, prior: LinkPrior
) -> FloatArray:
    """Share of the prior in the variance of each standard parameter of a chosen set, 0 to 1,
    shape (c,).

    A parameter that has no prior and that no torque depends on, as the rotor of a joint without a
    motor, has a share of 0: it is zero.

    Args:
        model: the declared model.
        grouping: G, shape (b, c).
        covariance: C of the base parameters, shape (b, b).
        prior: of each link, in the order of the robot's joints.
    """
    in_grouping = np.flatnonzero(grouping.any(axis=0))
    present = np.union1d(model.link_columns.ravel(), in_grouping)
    scale = _scales(model, prior)[present]
    # In units of the prior: a null space of kg together with kg m² would lose the small ones.
    scaled = grouping[:, present] * scale
    row_norms = np.linalg.norm(scaled, axis=1)
    scaled /= row_norms[:, None]
    null = linalg.null_space(scaled, rcond=_LOOSE)  # N
    precision = _precision(model, prior)[np.ix_(present, present)]
    precision *= np.outer(scale, scale)
    inner = null.T @ precision @ null
    inverse = np.linalg.pinv(inner, rcond=_LOOSE, hermitian=True)
    by_prior = null @ inverse @ null.T  # N (Nᵀ S⁻¹ N)⁻¹ Nᵀ
    inverse_grouping = np.linalg.pinv(scaled, rcond=_LOOSE)
    from_data = inverse_grouping / row_norms
    from_data -= by_prior @ precision @ from_data  # A
    data_variance = np.einsum("xb,bc,xc->x", from_data, covariance, from_data)  # diagonal of A C Aᵀ
    prior_variance = np.diag(by_prior)
    variance = prior_variance + data_variance
    own_shares = np.zeros(len(present))
    np.divide(prior_variance, variance, where=variance > 0.0, out=own_shares)
    # A direction without a prior that the data do not determine has no finite variance.
    loose = null - null @ (inverse @ inner)
    loose_size = np.linalg.norm(loose, axis=1)
    is_loose = loose_size > np.sqrt(_LOOSE)
    own_shares[is_loose] = 1.0
    shares = np.zeros(len(model.columns))
    shares[present] = own_shares
    return shares


def _scales(model: Model, prior: LinkPrior) -> FloatArray:
    """σ of the prior of each link parameter, and one for all else, shape (c,)."""
    link_std = np.linalg.norm(prior.directions(), axis=2)
    scale = np.ones(len(model.columns))
    scale[model.link_columns] = link_std
    return scale


def _precision(model: Model, prior: LinkPrior) -> FloatArray:
    """S⁻¹: zero for all but the links' parameters, shape (c, c)."""
    count = len(model.columns)
    precision = np.zeros((count, count))
    for columns, directions in zip(model.link_columns, prior.directions(), strict=True):
        whitening = np.linalg.inv(directions)
        precision[np.ix_(columns, columns)] = whitening.T @ whitening
    return precision
