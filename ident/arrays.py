"""Types of the arrays, whose shapes and units are in the docstrings; checks of arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from numbers import Real
from types import UnionType
from typing import Any, ParamSpec, TypeGuard, TypeVar

import numpy as np
from numpy.typing import NDArray

from ident.errors import ModelError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Refusal = Callable[[str], Exception]
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
LARGEST_NUMBER = 1e30  #: Size of a number, in any unit: products of three of them are still finite
SMALLEST_NUMBER = 1e-30  #: Of a number that divides others


def as_array(
    label: str,
    values: object,
    shape: tuple[int, ...] = (),
    meaning: str = "",
    refuse: Refusal = ModelError,
) -> FloatArray:
    """Convert an argument to finite numbers of a shape, any if empty; else raise ``refuse(…)``."""
    if isinstance(values, Mapping):
        keys = ", ".join(map(repr, values))
        order = meaning or "in the order of the axes"
        raise refuse(
            f"{label} is a dictionary with the keys {keys:.60}; expected numbers, {order}; "
            f"write [{label}[name] for name in axes]"
        )
    if values is not None:
        require_real(label, values, refuse, str(shape or "real numbers"))
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        expected = shape or "numbers"
        raise refuse(f"{label} is no array of numbers: {error}; expected {expected}") from error
    if shape and array.shape != shape:
        remedy = meaning
        if array.shape == shape[::-1]:
            remedy = f"{meaning}; transpose it?"
        raise refuse(f"{label} has shape {array.shape}; expected {shape}, {remedy}")
    not_finite = np.argwhere(~np.isfinite(array))
    if len(not_finite):
        if array.ndim == 0:
            raise refuse(f"{label} is {values!r}; expected an array of numbers")
        sample, *axes = not_finite[0].tolist()
        first = f"sample {sample}"
        if axes:
            first = f"{first}, axis {axes[0] + 1}"
        count = len(not_finite)
        raise refuse(f"{label} holds {count} non-finite values, the first in {first}; give numbers")
    return array


def require_real(
    label: str, values: object, refuse: Refusal, expected: str = "real numbers"
) -> None:
    """Refuse what numpy would convert with a loss, or without a word: complex, masked, text."""
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
        remedy = f"expected {expected}; give each row one length"
        raise refuse(f"{label} is no array of numbers: {error}; {remedy}") from error
    kind = array.dtype.kind
    if kind == "c":
        found = f"complex numbers ({array.dtype})"
        remedy = "expected real ones; give their real part: `.real`"
        raise refuse(f"{label} is of {found}; {remedy}")
    remedy = f"expected {expected}; convert it first: `.astype(float)`"
    if kind in "SUmM":
        found = f"its type is {array.dtype}"
        raise refuse(f"{label} is no array of numbers: {found}; {remedy}")
    if kind != "O":
        return
    # Data frames with columns of several types give such arrays; numbers in them are as good as
    # any.
    for value in array.ravel():
        if not isinstance(value, Real):
            type_name = type(value).__name__
            found = f"it holds {value!r:.60} of type {type_name}"
            raise refuse(f"{label} is no array of numbers: {found}; {remedy}")


def require_kind(label: str, value: object, kind: type, remedy: str) -> None:
    """Refuse an argument of another type, as a `ModelError`."""
    if not isinstance(value, kind):
        found = type(value).__name__
        expected = kind.__name__
        raise ModelError(f"{label} is of type {found}; expected {expected}; {remedy}")


def require_flag(label: str, value: object) -> None:
    """Refuse what is neither True nor False, as a `ModelError`: a text would count as True."""
    if not isinstance(value, (bool, np.bool_)):
        found = type(value).__name__
        raise ModelError(f"{label} is of type {found}; expected bool; give True or False")


def require_progress(progress: object) -> None:
    """Refuse what cannot be called with the text of a step, as a `ModelError`."""
    if not callable(progress):
        found = type(progress).__name__
        raise ModelError(
            f"progress is of type {found}; expected a function of one text; write progress=print"
        )


def as_gains(label: str, values: object, count: int) -> FloatArray:
    """Convert an argument to gains of so many motors, none of them zero; refuse others, as a
    `ModelError`.
    """
    gains = as_array(label, values, (count,), "one per motor")
    if not gains.all():
        raise ModelError(
            f"{label} is {gains.tolist()}; expected no zero: such a motor moves nothing"
        )
    return gains


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
    given_count = len(given)
    if count is not None and given_count != count:
        raise ModelError(
            f"{label} has {given_count} names; expected {count}, one for each axis; found {given}"
        )
    if label == "axes" and len(set(given)) < given_count:
        listed = ", ".join(given)
        raise ModelError(f"axes are {listed}; expected another name for each; rename one")


def require_entries(label: str, values: object, kind: type, remedy: str) -> None:
    """Refuse a list with entries of another type, as a `ModelError`; iterators are not read."""
    require_kind(label, values, Iterable, remedy)
    if isinstance(values, (str, Mapping)):  # which would count as their letters or keys
        found = type(values).__name__
        raise ModelError(f"{label} is of type {found}; expected a list; {remedy}")
    if isinstance(values, (Sequence, np.ndarray)):
        entry = f"an entry of {label}"
        for value in values:
            require_kind(entry, value, kind, remedy)


def require_number(
    label: str, value: object, *, above: float = -np.inf, remedy: str = "give a number"
) -> float:
    """Return one finite number above a bound as a float; refuse others, as a `ModelError`."""
    is_number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    bound = "a finite number"
    if above > -np.inf:
        bound = f"a finite number above {above:g}"
    if not is_number:
        type_name = type(value).__name__
        raise ModelError(
            f"{label} is {value!r:.60} of type {type_name}; expected {bound}; {remedy}"
        )
    number = as_float(value)
    if not above < number < np.inf:
        raise ModelError(f"{label} is {number:g}; expected {bound}; {remedy}")
    # A divisor may not be too small, either.
    is_too_small = above >= 0.0 and number < SMALLEST_NUMBER
    if is_too_small or abs(number) > LARGEST_NUMBER:
        sizes = f"at most {LARGEST_NUMBER:g} in size"
        if above >= 0.0:
            sizes = f"{SMALLEST_NUMBER:g} to {LARGEST_NUMBER:g} in size"
        raise ModelError(f"{label} is {number:g}; expected {bound}, {sizes}; {remedy}")
    return number


def as_float(value: object) -> float:
    """Convert a number; a whole one that no float holds is infinite, with its sign."""
    try:
        return float(value)  # type: ignore[arg-type]  # a number of any type
    except OverflowError:
        return float(np.copysign(np.inf, 1 if value > 0 else -1))  # type: ignore[operator]


def require_size(label: str, array: FloatArray, refuse: Refusal, remedy: str) -> None:
    """Refuse finite numbers whose products are not finite, as ``refuse(…)``."""
    largest = float(np.max(np.abs(array), initial=0.0))
    if largest <= LARGEST_NUMBER:
        return
    place = np.unravel_index(int(np.argmax(np.abs(array))), array.shape)
    where = ""
    if array.ndim == 2:
        where = f" in sample {place[0]}, axis {place[1] + 1}"
    raise refuse(
        f"{label} has {array[place]:g}{where}; expected at most {LARGEST_NUMBER:g} in size; "
        f"{remedy}"
    )


def is_whole_number(value: object) -> TypeGuard[int | np.integer[Any]]:
    """Whether it is an integer of Python or numpy; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def require_no_flag(label: str, value: object, remedy: str) -> None:
    """Refuse True and False, as a `ModelError`: to Python they are the numbers 1 and 0."""
    if isinstance(value, bool):
        raise ModelError(f"{label} is {value}; expected a number; {remedy}")


def require_count(label: str, value: object, *, remedy: str = "give a number such as 0") -> int:
    """Return a whole number, zero or above; refuse others, as a `ModelError`."""
    if not is_whole_number(value) or value < 0:
        raise ModelError(
            f"{label} is {value!r:.60}; expected a whole number, zero or above; {remedy}"
        )
    return int(value)


def true_stretches(flags: BoolArray) -> list[tuple[int, int]]:
    """First index and end of each stretch of set flags, shape (k,), ascending."""
    # A stretch begins at the even edges and ends at the odd ones.
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0)).tolist()
    begins = edges[::2]
    ends = edges[1::2]
    return list(zip(begins, ends, strict=True))


def takes(
    **kinds: type | UnionType,
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Make a function refuse arguments of another type by name, as a `ModelError`.

    It does so before it runs; likewise missing arguments, and those that it does not have.

    Args:
        kinds: of the arguments by their names; the type of others is not looked at. Neither is one
            that is left out.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(function)
        own_name = function.__name__

        @wraps(function)
        def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            try:
                given = signature.bind(*args, **kwargs).arguments
            except TypeError as error:
                expected = _call_of(own_name, signature)
                raise ModelError(
                    f"the call of {own_name} does not fit: {error}; expected {expected}; "
                    "give its arguments by these names"
                ) from error
            for name, value in given.items():
                if name in kinds and not isinstance(value, kinds[name]):
                    message = _of_another_kind(own_name, name, value, kinds[name], signature)
                    raise ModelError(message)
            return function(*args, **kwargs)

        return checked

    return decorate


def _of_another_kind(
    function: str, name: str, value: object, kind: type | UnionType, signature: inspect.Signature
) -> str:
    expected = str(kind)
    if isinstance(kind, type):
        expected = kind.__name__
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
    names: list[str] = []
    for dotted in kind.split(" | "):
        name = dotted.rsplit(".", 1)[-1]
        if name == "NoneType":
            name = "None"
        names.append(name)
    return " or ".join(names)
