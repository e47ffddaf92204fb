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
from daq.writeback.formats.scalar import CORRECT_KEY, ControllerDocument, KeyPath, Leaves, Scalar, unfit, utf8

MAX_DEPTH = 100
_BYTE_ORDER_MARK = "\ufeff"
_NUMBER = r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?"
_PLAIN = r"[^\"\\\x00-\x1f]*"
_STRING = rf"\"{_PLAIN}(?:\\(?:[\"\\/bfnrt]|u[0-9a-fA-F]{{4}}){_PLAIN})*\""
_TOKEN = re.compile(
    rf"[ \t\r\n]*(?:(?P<number>{_NUMBER})|(?P<string>{_STRING})|(?P<word>true|false|null)|(?P<mark>[\[\]{{}}:,]))"
)
_SPACE = re.compile(r"[ \t\r\n]*")


@dataclass(frozen=True, slots=True)
class JsonDocument(ControllerDocument):
    """A JSON file as it was read; our scanner and Python's parser must see the same in it."""

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`; a file with a key twice is refused."""
        leaves = _Scan(self.name, self.text).leaves()
        return tuple(self._locate(leaves, key) for key in keys)

    def readings(self) -> tuple[Leaves, Leaves]:
        """Read with our scanner, and with Python's parser."""
        scanned = _Scan(self.name, self.text).leaves()
        return {path: leaf.text for path, leaf in scanned.items()}, _loaded(self.text, self.name)

    def _locate(self, leaves: dict[KeyPath, _Leaf], key: str) -> Scalar:
        path = tuple(key.split("."))
        leaf = leaves.get(path)
        if leaf is not None and leaf.kind == "number":
            line = self.text.count("\n", 0, leaf.start) + 1
            return Scalar(key, float(leaf.text), leaf.text, leaf.start, leaf.start + len(leaf.text), line)
        if leaf is not None:
            raise unfit(self.name, key, f"{leaf.text:.60}", "write a plain number, without quotes")
        if (*path, "{}") in leaves or (*path, "[]") in leaves:
            raise unfit(self.name, key, "a list or mapping", "name the key of a number")
        for length in range(len(path), 0, -1):
            parent = path[: length - 1]
            if (*parent, "{}") in leaves or (*parent, "[]") in leaves:
                place = ".".join(parent) or "the file"
                inside = {
                    other[length - 1] for other in leaves if len(other) >= length and other[: length - 1] == parent
                }
                has = ", ".join(sorted(inside - {"{}", "[]"})[:12]) or "nothing"
                raise unfit(self.name, key, f"no key {path[length - 1]!r} in {place} (it has {has})", CORRECT_KEY)
            if parent in leaves:
                break
        raise unfit(self.name, key, f"no key {path[-1]!r} in {'.'.join(path[:-1]) or 'the file'}", CORRECT_KEY)


@dataclass(frozen=True, slots=True)
class _Leaf:
    """A value in the text."""

    kind: str
    text: str
    start: int


def json_document(content: bytes, name: str) -> JsonDocument:
    """Parse a JSON document.

    Raises:
        ControllerUnfit: they are not UTF-8.
    """
    return JsonDocument(name, utf8(content, name, "JSON"))


class _Scan:
    """A scan of the text."""

    def __init__(self, name: str, text: str) -> None:
        self._name = name
        self._text = text
        self._at = len(_BYTE_ORDER_MARK) if text.startswith(_BYTE_ORDER_MARK) else 0
        self._found: dict[KeyPath, _Leaf] = {}

    def leaves(self) -> dict[KeyPath, _Leaf]:
        """Return every value with its place, and `{}` or `[]` with the size of every object and list.

        Raises:
            ControllerUnfit: this is no JSON, or a key is there twice.
        """
        self._value((), self._next())
        match = _SPACE.match(self._text, self._at)
        if match is None or match.end() != len(self._text):
            raise self._wrong(match.end() if match else self._at, "the end of the file")
        return self._found

    def _value(self, path: KeyPath, token: _Leaf) -> None:
        if len(path) > MAX_DEPTH:
            raise self._wrong(token.start, f"at most {MAX_DEPTH} lists in lists", "more")
        if token.text == "{":
            self._object(path, token)
        elif token.text == "[":
            self._list(path, token)
        elif token.kind == "mark":
            raise self._wrong(token.start, "a value")
        else:
            self._found[path] = token

    def _object(self, path: KeyPath, begin: _Leaf) -> None:
        size = 0
        keys: set[str] = set()
        token = self._next()
        while size or token.text != "}":
            if token.kind != "string":
                raise self._wrong(token.start, "a key in quotes")
            key: str = json.loads(token.text)
            if key in keys:
                raise self._wrong(token.start, "each key once", f"{token.text:.60} a second time")
            keys.add(key)
            self._mark(":")
            self._value((*path, key), self._next())
            size += 1
            if self._mark(",}").text == "}":
                break
            token = self._next()
        self._found[*path, "{}"] = _Leaf("size", str(size), begin.start)

    def _list(self, path: KeyPath, begin: _Leaf) -> None:
        size = 0
        token = self._next()
        while size or token.text != "]":
            self._value((*path, str(size)), token)
            size += 1
            if self._mark(",]").text == "]":
                break
            token = self._next()
        self._found[*path, "[]"] = _Leaf("size", str(size), begin.start)

    def _mark(self, allowed: str) -> _Leaf:
        token = self._next()
        if token.kind != "mark" or token.text not in allowed:
            raise self._wrong(token.start, " or ".join(allowed))
        return token

    def _next(self) -> _Leaf:
        match = _TOKEN.match(self._text, self._at)
        if match is None:
            space = _SPACE.match(self._text, self._at)
            raise self._wrong(space.end() if space else self._at, "a value, a key or a mark of JSON")
        self._at = match.end()
        kind = match.lastgroup or ""
        return _Leaf(kind, match[kind], match.start(kind))

    def _wrong(self, at: int, expected: str, found: str | None = None) -> ControllerUnfit:
        shown = found or (repr(self._text[at : at + 20]) if at < len(self._text) else "the end of the file")
        line = self._text.count("\n", 0, at) + 1
        return ControllerUnfit(
            f"{self._name}:{line}",
            found=shown,
            expected=f"{expected}, as JSON has it",
            remedy="correct the file (JSON knows no comments, no NaN and no Infinity); nothing was written",
        )


def _loaded(text: str, name: str) -> dict[KeyPath, str]:
    """Read the leaves with Python's parser; numbers stay text."""
    try:
        tree = json.loads(text.removeprefix(_BYTE_ORDER_MARK), parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError) as error:
        raise ControllerUnfit(
            name,
            found=f"no JSON ({error})",
            expected="one JSON document",
            remedy="correct the file; nothing was written",
        ) from error
    return dict(_walk((), tree))


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
