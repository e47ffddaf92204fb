"""Pure functions that compute each result once, for tests that ask for the same one along several
ways.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def remembered(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function of the same results, which are kept by the content of the arguments.

    Arguments that differ in a single bit are computed. An error is not kept.

    Args:
        function: its result depends on its arguments alone, and nobody changes it.
    """
    results: dict[bytes, R] = {}

    @wraps(function)
    def remembering(*args: P.args, **kwargs: P.kwargs) -> R:
        key = hashlib.sha256(pickle.dumps((args, kwargs))).digest()
        if key not in results:
            results[key] = function(*args, **kwargs)
        return results[key]

    return remembering
