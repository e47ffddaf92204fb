"""Find the gains in a controller's YAML."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from daq.config.yaml_file import yaml_events
from daq.errors import ControllerUnfit
from daq.formats.scalar import (
    DECIMAL,
    OCTAL,
    ControllerDocument,
    KeyPath,
    Scalar,
    Values,
    utf8,
)

#: Limits of a file: two parsers in Python, which are slow, read it before and after a change
MAX_BYTES = 2**19
MAX_VALUES = 15_000
MAX_DEPTH = 100
_MERGE = "<<"  #: Key of YAML 1.1 that adds the keys of another mapping
_TABS = re.compile(r"(?<=:)[ ]*\t[ \t]*|[ \t]*\t[ \t]*(?=#|\r|\n|\Z)")
"""Tabs after a key, before a comment and at the end of a line:
white space in YAML 1.2 (6.1, 6.6) and to libyaml.
"""
_FLOAT = "tag:yaml.org,2002:float"


@dataclass(frozen=True, slots=True)
class YamlDocument(ControllerDocument):
    """A YAML file as it was read.

    ruamel.yaml reads YAML 1.2 and PyYAML reads YAML 1.1: whichever the controller uses, it sees the
    same.
    """

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`."""
        root = _composed(self.text, self.name, "1.2")
        visits = _count_visits(root)
        return tuple(self._locate(root, key, visits) for key in keys)

    def readings(self) -> tuple[Values, Values]:
        """Read as YAML 1.2 and as YAML 1.1."""
        older = _composed(self.text, self.name, "1.1")
        return self.first_reading(), _values(older)

    def first_reading(self) -> Values:
        """Read as YAML 1.2."""
        return _values(_composed(self.text, self.name, "1.2"))

    def _locate(self, root: Node, key: str, visits: Counter[int]) -> Scalar:
        """Find the number of a key.

        Args:
            root: of the tree.
            key: as in the cell configuration.
            visits: of `_count_visits`.

        Raises:
            ControllerUnfit: there is none that can be changed on its own.
        """
        node = root
        walked: KeyPath = ()
        for step in self.path_of(key):
            node = self._child(node, step, key, walked)
            walked = (*walked, step)
            # A value that another place refers to by an alias cannot be changed without changing
            # that place too.
            if visits[id(node)] > 1:
                found = f"{'.'.join(walked)} shared by an anchor (&) and its alias (*)"
                raise self.unfit(key, found, "write it out")
        if not isinstance(node, ScalarNode):
            raise self.unfit(key, "a list or mapping", "name the key of a number")
        # The number is at the end of its node: an anchor or a tag may precede it.
        quote = node.style or ""
        end = node.end_mark.index - len(quote)
        start = end - len(node.value)
        before = self.text[start - 1 : start]
        if quote:
            is_at_begin = before == quote
        else:
            is_at_begin = start == node.start_mark.index or before.isspace()
        # With an escape within the quotes, the text is another than the value.
        is_literal = is_at_begin and self.text[start:end] == node.value
        if not is_literal or not DECIMAL.fullmatch(node.value):
            raise self.unfit(key, f"{node.value!r:.60}", "write a plain decimal number")
        if OCTAL.fullmatch(node.value):
            found = (
                f"{node.value!r:.60}, which is octal to readers of YAML 1.1 and decimal to "
                "those of 1.2"
            )
            raise self.unfit(key, found, "write it without leading zeros")
        # A tag may not make the number a text or an integer: a new gain has a point, and is no
        # integer even where this one is. A bare ! makes it a text, whatever the parser calls it.
        properties = self.text[node.start_mark.index : start].split()
        tags = [part for part in properties if part.startswith("!")]
        if tags and (tags[0] == "!" or node.tag != _FLOAT):
            raise self.unfit(
                key, f"the tag {tags[0]:.60} before it", "remove the tag, or make it !!float"
            )
        line = node.start_mark.line + 1
        return self.decimal_scalar(key, node.value, start, line)

    def _child(self, node: Node, step: str, key: str, walked: KeyPath) -> Node:
        """Return the child of a node at one step of a key; `walked` are the steps before.

        Raises:
            ControllerUnfit: there is none, or more than one.
        """
        place = ".".join(walked) or "the file"
        if isinstance(node, SequenceNode):
            if step.isdecimal() and int(step) < len(node.value):
                child: Node = node.value[int(step)]
                return child
            positions = ", ".join(str(position) for position in range(len(node.value))[:12])
            has = positions or "nothing"
            raise self.lacking(key, f"no key {step!r} in {place} (it has {has})")
        if not isinstance(node, MappingNode):
            raise self.lacking(key, f"no key {step!r} in {place}")
        names: list[str] = []
        found: list[Node] = []
        for name, value in node.value:
            if not isinstance(name, ScalarNode):
                continue
            names.append(str(name.value))
            if name.value == step:
                found.append(value)
        if len(found) > 1:
            raise self.unfit(key, f"{step!r} {len(found)} times in {place}", "remove all but one")
        if not found:
            if _MERGE in names:
                text = f"no {step!r} of its own in {place}, which merges (<<) another"
                raise self.unfit(key, text, "write it out")
            has = ", ".join(names[:12]) or "nothing"
            raise self.lacking(key, f"no key {step!r} in {place} (it has {has})")
        return found[0]


def yaml_document(content: bytes, name: str) -> YamlDocument:
    """Parse a YAML document.

    Raises:
        ControllerUnfit: the bytes are not UTF-8, or the file is too large, has too many values or
            is nested too deeply for the two parsers.
    """
    _check_size(content, name)
    return YamlDocument(name, utf8(content, name, "YAML"))


def _check_size(content: bytes, name: str) -> None:
    """Refuse a file for which the two parsers would take minutes.

    Raises:
        ControllerUnfit: it is too large.
    """
    found = ""
    if len(content) > MAX_BYTES:
        found = f"{len(content)} bytes"
    elif _is_large(content):
        found = f"more than {MAX_VALUES} values, or lists in lists deeper than {MAX_DEPTH}"
    if found:
        expected = f"at most {MAX_BYTES} bytes, {MAX_VALUES} values, {MAX_DEPTH} lists in lists"
        raise ControllerUnfit(
            name,
            found=f"YAML with {found}",
            expected=expected,
            remedy="is this the controller's file? then keep its gains in a file of their own; "
            "nothing was written",
        )


def _is_large(content: bytes) -> bool:
    """Return whether a file has too many values or too deep lists, by its events alone."""
    with contextlib.suppress(yaml.YAMLError, ValueError):  # explained by the parsers
        for _, depth, values in yaml_events(content):
            if values > MAX_VALUES or depth > MAX_DEPTH:
                return True
    return False


# Composing is expensive, and a write reads each of its two texts several times
@lru_cache(maxsize=8)
def _composed(text: str, name: str, version: str) -> Any:
    """Return the root of a file's tree, by the parser of a version of YAML: 1.2 or 1.1.

    Raises:
        ControllerUnfit: it is no YAML, or empty.
    """
    # The parsers in Python refuse these tabs. As many blanks keep every place in the text; the text
    # itself keeps its tabs, and `locate` compares each number with it.
    text = _TABS.sub(lambda tabs: " " * len(tabs[0]), text)
    root = None
    fault = "nothing in it"
    try:
        if version == "1.2":
            root = YAML(typ="safe", pure=True).compose(text)
        else:
            root = yaml.compose(text, Loader=yaml.SafeLoader)
    except RecursionError:
        fault = "too many lists in lists"
    except (YAMLError, yaml.YAMLError, ValueError) as error:
        fault = " ".join(str(error).split())[:200]
    if root is None:
        raise ControllerUnfit(
            name,
            found=f"no YAML {version} ({fault})",
            expected="the controller's parameters, in one YAML document for readers of both YAML "
            "1.1 and 1.2",
            remedy="is this the right file? If it is, correct it; nothing was written",
        )
    return root


def _count_visits(root: Node) -> Counter[int]:
    """Count from how many places each node is reached, by its id: more than one means an alias."""
    visits = Counter[int]()
    waiting = [root]
    while waiting:
        node = waiting.pop()
        visits[id(node)] += 1
        if visits[id(node)] > 1:
            continue  # its children are counted
        if isinstance(node, MappingNode):
            for name, value in node.value:
                waiting += [name, value]
        elif isinstance(node, SequenceNode):
            waiting += node.value
    return visits


def _values(root: Any) -> dict[KeyPath, str]:
    """Return every scalar of a tree by its path, and the size of every list and mapping.

    The two parsers have unrelated node classes whose parts have the same names. A node that an
    alias repeats is followed once: it is the same text. A key that is no scalar has its position
    in the path.
    """
    values: dict[KeyPath, str] = {}
    seen: set[int] = set()
    waiting: list[tuple[KeyPath, Any]] = [((), root)]
    while waiting:
        path, node = waiting.pop()
        if id(node) in seen:
            values[path] = "*"
        elif isinstance(node.value, str):
            values[path] = node.value
        elif type(node).__name__ == "SequenceNode":
            values[*path, "[]"] = str(len(node.value))
            for position, child in enumerate(node.value):
                waiting.append(((*path, str(position)), child))
        else:
            values[*path, "{}"] = str(len(node.value))
            for position, (name, value) in enumerate(node.value):
                step = f"? {position}"  # YAML's mark of a key that is a list or mapping
                if isinstance(name.value, str):
                    step = name.value
                waiting.append(((*path, step), value))
        seen.add(id(node))
    return values
