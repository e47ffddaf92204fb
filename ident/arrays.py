"""Types of the arrays, whose shapes and units are in the docstrings; checks of arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from numbers import Real
from types import UnionType
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from ident.errors import ModelError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Refusal = Callable[[str], Exception]
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def as_array(
    label: str,
    values: object,
    shape: tuple[int, ...] = (),
    meaning: str = "",
    refuse: Refusal = ModelError,
) -> FloatArray:
    """Convert an argument to finite numbers of a shape, any if empty;
    otherwise raise what ``refuse`` makes.
    """
    if isinstance(values, Mapping):
        keys = ", ".join(map(repr, values))
        raise refuse(
            f"{label} is a dictionary with the keys {keys:.60}; expected numbers, "
            f"{meaning or 'in the order of the axes'}; write [{label}[name] for name in axes]"
        )
    if values is not None:
        require_real(label, values, refuse, str(shape or "real numbers"))
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise refuse(
            f"{label} is no array of numbers: {error}; expected {shape or 'numbers'}"
        ) from error
    if shape and array.shape != shape:
        if array.shape == shape[::-1]:
            turned = "; transpose it?"
        else:
            turned = ""
        raise refuse(f"{label} has shape {array.shape}; expected {shape}, {meaning}{turned}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        if array.ndim == 0:
            raise refuse(f"{label} is {values!r}; expected an array of numbers")
        first = f"sample {bad[0][0]}" + (f", axis {bad[0][1] + 1}" if array.ndim > 1 else "")
        raise refuse(
            f"{label} holds {len(bad)} non-finite values, the first in {first}; give numbers"
        )
    return array


def require_real(
    label: str, values: object, refuse: Refusal, expected: str = "real numbers"
) -> None:
    """Refuse what numpy would convert to real numbers with a loss, or without a word:
    complex, masked, text.
    """
    if np.ma.isMaskedArray(values):
        masked = int(np.count_nonzero(np.ma.getmaskarray(values)))
        if masked:
            remedy = "fill them, or mark them in `Run.valid`: `array.filled(...)`"
            raise refuse(
                f"{label} is a masked array with {masked} masked values; expected numbers; {remedy}"
            )
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise refuse(
            f"{label} is no array of numbers: {error}; expected {expected}; give each row "
            "one length"
        ) from error
    if array.dtype.kind == "c":
        raise refuse(
            f"{label} is of complex numbers ({array.dtype}); expected real ones; give their real "
            "part: `.real`"
        )
    if array.dtype.kind in "SUmM":
        remedy = "convert it first: `.astype(float)`"
        raise refuse(
            f"{label} is no array of numbers: its type is {array.dtype}; expected "
            f"{expected}; {remedy}"
        )
    if array.dtype.kind != "O":
        return
    # Data frames with columns of several types give such arrays; numbers in them are as good as
    # any.
    for value in array.ravel():
        if not isinstance(value, Real):
            found = f"it holds {value!r:.60} of type {type(value).__name__}"
            remedy = "convert it first: `.astype(float)`"
            raise refuse(f"{label} is no array of numbers: {found}; expected {expected}; {remedy}")


def require_kind(label: str, value: object, kind: type, remedy: str) -> None:
    """Refuse an argument of another type, as a `ModelError`."""
    if not isinstance(value, kind):
        raise ModelError(
            f"{label} is of type {type(value).__name__}; expected {kind.__name__}; {remedy}"
        )


def require_names(label: str, names: object, count: int | None = None) -> None:
    """Refuse what is no list of names, one an axis where a count is given, as a `ModelError`.

    A single text would count as one name a letter.
    """
    if isinstance(names, str):
        raise ModelError(
            f"{label} is the text {names!r:.60}; expected a list of names; write [{names!r:.60}]"
        )
    require_entries(label, names, str, "give a list of names: ['J1', 'J2']")
    given = list(names)  # type: ignore[call-overload]
    if count is not None and len(given) != count:
        raise ModelError(
            f"{label} has {len(given)} names; expected {count}, one for each axis; found {given}"
        )
    if label == "axes" and len(set(given)) < len(given):
        raise ModelError(f"axes are {', '.join(given)}; expected another name for each; rename one")


def require_entries(label: str, values: object, kind: type, remedy: str) -> None:
    """Refuse a list whose entries are of another type, as a `ModelError`;
    an iterator is not looked into.
    """
    require_kind(label, values, Iterable, remedy)
    if isinstance(values, (Sequence, np.ndarray)):
        for value in values:
            require_kind(f"an entry of {label}", value, kind, remedy)


def require_number(
    label: str, value: object, *, above: float = -np.inf, remedy: str = "give a number"
) -> float:
    """Return an argument that is one finite number above a bound, as a float;
    refuse others, as a `ModelError`.
    """
    is_number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    if above == -np.inf:
        bound = "a finite number"
    else:
        bound = f"a finite number above {above:g}"
    if not is_number:
        raise ModelError(
            f"{label} is {value!r:.60} of type {type(value).__name__}; expected {bound}; {remedy}"
        )
    number = float(value)  # type: ignore[arg-type]  # isinstance does not narrow through the name above
    if not above < number < np.inf:
        raise ModelError(f"{label} is {number:g}; expected {bound}; {remedy}")
    return number


def require_count(label: str, value: object, *, remedy: str = "give a number such as 0") -> int:
    """Return an argument that is a whole number, zero or above;
    refuse others, as a `ModelError`.
    """
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_whole or value < 0:  # type: ignore[operator]
        raise ModelError(
            f"{label} is {value!r:.60}; expected a whole number, zero or above; {remedy}"
        )
    return int(value)  # type: ignore[call-overload, no-any-return]


def takes(
    **kinds: type | UnionType,
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Make a function refuse arguments of another type by name, as a `ModelError`, before it runs;
    likewise missing arguments, and those that it does not have.

    Args:
        kinds: of the arguments by their names; the type of others is not looked at. Neither is one
            that is left out.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(function)

        @wraps(function)
        def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            try:
                given = signature.bind(*args, **kwargs).arguments
            except TypeError as error:
                raise ModelError(
                    f"the call of {function.__name__} does not fit: {error}; expected "
                    f"{_call_of(function.__name__, signature)}; give its arguments by these names"
                ) from error
            for name, value in given.items():
                if name in kinds and not isinstance(value, kinds[name]):
                    raise ModelError(
                        _of_another_kind(function.__name__, name, value, kinds[name], signature)
                    )
            return function(*args, **kwargs)

        return checked

    return decorate


def _of_another_kind(
    function: str, name: str, value: object, kind: type | UnionType, signature: inspect.Signature
) -> str:
    expected = kind.__name__ if isinstance(kind, type) else str(kind)
    found = f"{name} of {function} is of type {type(value).__name__}"
    if kind is np.random.Generator:
        remedy = f"write {name}=np.random.default_rng(0)"
    elif kind in {Sequence, Iterable}:
        remedy = f"give a list, with one entry too: {name}=[...]"
    else:
        remedy = f"call {_call_of(function, signature)}"
    return f"{found}; expected {_short(expected)}; {remedy}"


def _call_of(function: str, signature: inspect.Signature) -> str:
    """A call with the names of its arguments; those that may be left out are in brackets."""
    needed: list[str] = []
    optional: list[str] = []
    for name, parameter in signature.parameters.items():
        if parameter.default is inspect.Parameter.empty:
            needed.append(name)
        else:
            optional.append(name)
    if optional:
        needed.append(f"[{', '.join(optional)}]")
    return f"{function}({', '.join(needed)})"


def _short(kind: str) -> str:
    """Names of types without their modules: `ident.data.run.Run | None` is `Run or None`."""
    names = [name.rsplit(".", 1)[-1] for name in kind.split(" | ")]
    return " or ".join("None" if name == "NoneType" else name for name in names)
