"""Machine code for the inner loops, kept on disk so that only the first run on a machine compiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile with numba, cached in the ``__pycache__`` beside the function's file (NUMBA_CACHE_DIR overrides it).

    numba invalidates a cached function when its own file changes, not when a function it calls in another file does:
    so compiled functions call only compiled functions of their own file.
    """
    return cast(F, numba.njit(cache=True)(function))
