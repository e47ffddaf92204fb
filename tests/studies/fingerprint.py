"""Fingerprints of what a study has made, so that what is finished and still the same is not made
again.
"""

from __future__ import annotations

import ast
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daq.files import replace_file

ROOMS = ("daq", "drivers", "ident")
CHECKOUT = Path(__file__).parents[2]


def digest(*things: object) -> str:
    """sha256 of tuples, frozen dataclasses, texts and numbers, by their exact `repr`, hex."""
    encoded_things_repr = repr(things).encode()
    return hashlib.sha256(encoded_things_repr).hexdigest()


def digest_of_source(module: str, rooms: tuple[str, ...] = ROOMS) -> str:
    """Digest of a module and of all modules of this repository that it imports, in hex;
    docstrings and comments apart.

    Args:
        module: dotted name.
        rooms: beginnings of the names of modules that are followed.
    """
    sources: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = CHECKOUT / Path(*name.split(".")).with_suffix(".py")
        if name in sources or not path.is_file():
            continue
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(rooms):
                # `from ident.estimators import wls` may name a module as well as a function.
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        sources[name] = ast.dump(_Wordless().visit(tree))
    return digest(*sorted(sources.items()))


def is_finished(path: Path, fingerprint: str) -> bool:
    """Whether a file is there and was marked with this fingerprint."""
    mark = mark_of(path)
    return path.is_file() and mark.is_file() and mark.read_text().strip() == fingerprint


def finish(path: Path, fingerprint: str) -> None:
    """Mark a finished file."""
    replace_file(mark_of(path), f"{fingerprint}\n".encode())


def made_once(
    out: Path, name: str, fingerprint: str, make: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """Return the document `name`.json of a folder;
    it is made unless it is there with this fingerprint.

    Args:
        out: the folder.
        name: of the document, and of the folder of logs that is deleted once it is made.
        fingerprint: of what it depends on.
        make: fills the folder of logs and returns the document.
    """
    path = out / f"{name}.json"
    logs = out / name
    if not is_finished(path, fingerprint):
        shutil.rmtree(logs, ignore_errors=True)
        logs.mkdir(parents=True)
        content = f"{json.dumps(make(logs), indent=2)}\n".encode()
        replace_file(path, content)
        finish(path, fingerprint)
        shutil.rmtree(logs)
    text = path.read_text(encoding="utf-8")
    document: dict[str, Any] = json.loads(text)
    return document


def mark_of(path: Path) -> Path:
    """Return the file that holds the fingerprint of a finished file."""
    return path.with_name(path.name + ".fingerprint")


class _Wordless(ast.NodeTransformer):
    """Removes docstrings: texts that are statements."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else node
