"""Types of the arrays, whose shapes and units are in the docstrings; checks of arguments."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from ident.errors import ModelError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Refusal = Callable[[str], Exception]


def as_array(
    label: str, values: object, shape: tuple[int, ...] = (), meaning: str = "", refuse: Refusal = ModelError
) -> FloatArray:
    """Convert an argument to finite numbers of a shape, any if empty; otherwise raise what ``refuse`` makes."""
    if np.ma.is_masked(values):
        raise refuse(f"{label} masks some of its values; expected a number for each; cut these rows out, or fill them")
    try:
        given = np.asarray(values)
        is_complex = np.iscomplexobj(given)
        array = given.real.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise refuse(f"{label} is no array of numbers: {error}; expected {shape or 'numbers'}") from error
    if is_complex:
        raise refuse(f"{label} holds complex numbers; expected real ones; take their `.real` where that is meant")
    if shape and array.shape != shape:
        turned = "; transpose it?" if array.shape == shape[::-1] else ""
        raise refuse(f"{label} has shape {array.shape}; expected {shape}, {meaning}{turned}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        if array.ndim == 0:
            raise refuse(f"{label} is {values!r}; expected an array of numbers")
        first = f"sample {bad[0][0]}" + (f", axis {bad[0][1] + 1}" if array.ndim > 1 else "")
        raise refuse(f"{label} holds {len(bad)} non-finite values, the first in {first}; give numbers")
    return array


def require_kind(label: str, value: object, kind: type, remedy: str) -> None:
    """Refuse an argument of another type, as a `ModelError`."""
    if not isinstance(value, kind):
        raise ModelError(f"{label} is of type {type(value).__name__}; expected {kind.__name__}; {remedy}")


def require_number(label: str, value: object, least: float, most: float, remedy: str) -> None:
    """Refuse an argument that is no number from ``least`` to ``most``, both included, as a `ModelError`."""
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if not is_number or not least <= float(value) <= most:  # type: ignore[arg-type]  # a Real
        raise ModelError(f"{label} is {value!r}; expected a number from {least:g} to {most:g}; {remedy}")
