"""Find the gains in a controller's JSON.

Source: RFC 8259. Stricter where readers differ: no key twice, at most MAX_DEPTH lists in lists.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from daq.errors import ControllerUnfit
from daq.formats.scalar import ControllerDocument, KeyPath, Scalar, Values, utf8

MAX_DEPTH = 100
_BYTE_ORDER_MARK = "\ufeff"
_TOKEN = re.compile(
    r"(?P<number>-?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)"
    r"|(?P<string>\"[^\"\\]*(?:\\.[^\"\\]*)*\")|(?P<word>true|false|null)|(?P<mark>[\[\]{}:,])"
)


@dataclass(frozen=True, slots=True)
class JsonDocument(ControllerDocument):
    """A JSON file as it was read; our scanner and Python's parser must see the same in it."""

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`; a file with a key twice is refused."""
        tokens = self._scanned()
        return tuple(self._locate(tokens, key) for key in keys)

    def readings(self) -> tuple[Values, Values]:
        """Read with our scanner, and with Python's parser."""
        return self.first_reading(), self._loaded()

    def first_reading(self) -> Values:
        """Read with our scanner."""
        return {path: token.text for path, token in self._scanned().items()}

    def _scanned(self) -> dict[KeyPath, _Token]:
        """Return every value with its place, and `{}` or `[]` with the size of every object and
        list.
        """
        self._loaded()  # refuses all that is not JSON: the scanner need not
        tokens = _tokens(self.text)
        return dict(self._scan(tokens, (), next(tokens)))

    def _scan(
        self, tokens: Iterator[_Token], path: KeyPath, token: _Token
    ) -> Iterator[tuple[KeyPath, _Token]]:
        if len(path) > MAX_DEPTH:
            raise self._no_json(f"more than {MAX_DEPTH} lists in lists")
        if token.text not in ("{", "["):
            yield path, token
            return
        size = 0
        is_object = token.text == "{"
        for inner in tokens:
            if inner.text in ("}", "]"):
                break
            if inner.text == ",":
                continue
            if is_object:
                name = json.loads(inner.text)
                next(tokens)  # the colon
                yield from self._scan(tokens, (*path, name), next(tokens))
            else:
                yield from self._scan(tokens, (*path, str(size)), inner)
            size += 1
        brackets = "[]"
        if is_object:
            brackets = "{}"
        yield (*path, brackets), _Token("size", str(size), token.start)

    def _loaded(self) -> dict[KeyPath, str]:
        """Read the values with Python's parser; numbers stay text."""
        try:
            tree = json.loads(
                self.text.removeprefix(_BYTE_ORDER_MARK),
                parse_float=str,
                parse_int=str,
                parse_constant=_refuse_constant,
                object_pairs_hook=_unique,
            )
        except json.JSONDecodeError as error:
            raise self._no_json(_broken_place(error.doc, error.pos)) from error
        except RecursionError as error:
            raise self._no_json("too many lists in lists") from error
        except ValueError as error:
            raise self._no_json(str(error)) from error
        return dict(_walk((), tree))

    def _no_json(self, found: str) -> ControllerUnfit:
        return ControllerUnfit(
            self.name,
            found=f"no JSON ({found})",
            expected=f"one JSON document, each key once, at most {MAX_DEPTH} lists in lists",
            remedy="correct the file (JSON knows no comments, no NaN and no Infinity); nothing "
            "was written",
        )

    def _locate(self, tokens: dict[KeyPath, _Token], key: str) -> Scalar:
        path = self.path_of(key)
        token = tokens.get(path)
        if token is not None and token.kind == "number":
            line = self.text.count("\n", 0, token.start) + 1
            return self.decimal_scalar(key, token.text, token.start, line)
        if token is not None:
            raise self.unfit(key, f"{token.text:.60}", "write a plain number, without quotes")
        if _is_container(tokens, path):
            raise self.unfit(key, "a list or mapping", "name the key of a number")
        for depth in reversed(range(len(path))):
            parent = path[:depth]
            if _is_container(tokens, parent):
                place = ".".join(parent) or "the file"
                names = {
                    other[depth]
                    for other in tokens
                    if len(other) > depth and other[:depth] == parent
                }
                names -= {"{}", "[]"}
                has = ", ".join(sorted(names)[:12]) or "nothing"
                raise self.lacking(key, f"no key {path[depth]!r} in {place} (it has {has})")
            if parent in tokens:
                break
        *parents, last = path
        place = ".".join(parents) or "the file"
        raise self.lacking(key, f"no key {last!r} in {place}")


@dataclass(frozen=True, slots=True)
class _Token:
    """A value in the text."""

    kind: str
    text: str
    start: int


def _tokens(text: str) -> Iterator[_Token]:
    for found in _TOKEN.finditer(text):
        yield _Token(found.lastgroup or "", found[0], found.start())


def _is_container(tokens: dict[KeyPath, _Token], path: KeyPath) -> bool:
    """Whether an object or a list is at a path."""
    return (*path, "{}") in tokens or (*path, "[]") in tokens


def json_document(content: bytes, name: str) -> JsonDocument:
    """Parse a JSON document.

    Raises:
        ControllerUnfit: the bytes are not UTF-8.
    """
    return JsonDocument(name, utf8(content, name, "JSON"))


def _broken_place(text: str, position: int) -> str:
    """Say where a text stops being JSON, and what is there:
    the parser's own words differ between versions of Python.

    So does the place of a comma too many: the comma since 3.13, what follows it before.
    """
    before = text[:position].rstrip()
    character = text[position : position + 1]
    if character in ("}", "]") and before.endswith(","):
        position = len(before) - 1
    line = text.count("\n", 0, position) + 1
    column = position - text.rfind("\n", 0, position)
    rest_of_line, _, _ = text[position:].partition("\n")
    rest = rest_of_line.strip()
    found = "the end of the line"
    if rest:
        found = f"'{rest:.40}'"
    return f"line {line} column {column}: {found}"


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name}, which is no number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{json.dumps(key):.60} a second time")
        found[key] = value
    return found


def _walk(path: KeyPath, tree: Any) -> Iterator[tuple[KeyPath, str]]:
    if isinstance(tree, dict):
        yield (*path, "{}"), str(len(tree))
        for key, value in tree.items():
            yield from _walk((*path, key), value)
    elif isinstance(tree, list):
        yield (*path, "[]"), str(len(tree))
        for position, value in enumerate(tree):
            yield from _walk((*path, str(position)), value)
    else:
        yield path, str(tree)
