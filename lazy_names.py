"""Front doors of packages: a name brings its module along when it is first used,
so importing the package stays light.

A package lists its names once, where type checkers and editors look for them, and `lazy_names`
reads that list::

    if TYPE_CHECKING:
        from package.module import Name as Name

        __all__: list[str]
    else:
        __getattr__, __dir__ = lazy_names(__name__)
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path


def lazy_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package (PEP 562)
    for the names that it imports for type checkers.

    Args:
        package: name of the package, `__name__` in its `__init__.py`.
    """

    @cache  # read at the first name: a program that uses none does not wait for it
    def homes() -> dict[str, str]:
        return _homes(Path(str(sys.modules[package].__file__)).read_bytes())

    def load(name: str) -> object:
        if name == "__all__":
            return list(homes())
        if name not in homes():
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}; it exports {', '.join(homes())}"
            )
        try:
            module = import_module(homes()[name])
        except ImportError as error:
            found = shadowed_package()
            if found:
                raise ImportError(found, name=error.name, path=error.path) from error
            raise
        value = getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return list(homes())

    return load, names


PACKAGES = ("daq", "drivers", "ident")


def shadowed_package() -> str:
    """Describe a file or folder that Python has imported in the place of one of the packages;
    empty without one.

    The names of the packages are common: a folder `drivers` next to a script comes before an
    installed package.
    """
    home = Path(__file__).resolve().parent
    for name in PACKAGES:
        module = sys.modules.get(name)
        if module is None:
            continue
        file = getattr(module, "__file__", None)
        place = Path(file or next(iter(module.__path__))).resolve()
        if place.name == "__init__.py":
            place = place.parent
        if place != home / name:
            return (
                f"{name!r}: found {place}, which Python imports in the place of drivegain's "
                "package; expected "
                f"{home / name}; rename {place.name!r}, or start Python in another folder"
            )
    return ""


def _homes(source: bytes) -> dict[str, str]:
    """Module of each name that is imported under `if TYPE_CHECKING`."""
    homes: dict[str, str] = {}
    for block in ast.parse(source).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for statement in block.body:
                if isinstance(statement, ast.ImportFrom) and statement.module:
                    homes.update(
                        dict.fromkeys((alias.name for alias in statement.names), statement.module)
                    )
    return homes
