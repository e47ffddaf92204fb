"""Types of the arrays, whose shapes and units are in the docstrings; checks of arguments."""

from __future__ import annotations

from collections.abc import Callable

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
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise refuse(f"{label} is no array of numbers: {error}; expected {shape or 'numbers'}") from error
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
