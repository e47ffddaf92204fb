"""A controller's YAML: where its gains stand, and the same text with other numbers there."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from daq.errors import ControllerUnfit
from daq.write_back.scalar import CORRECT_KEY, KeyPath, Scalar, check_leaves, check_text, spliced, unfit

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_MERGE = "<<"


@dataclass(frozen=True, slots=True)
class YamlDocument:
    """A YAML file as it was read; a number is named by its dotted path (`drives.J1.gain`, `gains.0`).

    Attributes:
        name: what to call it in messages.
        text: all of it, a byte order mark and the line ends included.
    """

    name: str
    text: str

    @property
    def content(self) -> bytes:
        """The text as it stands in the file."""
        return self.text.encode()

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """Find the numbers at some dotted paths, in their order.

        Raises:
            ControllerUnfit: the file does not parse, or a path leads to no number that can be changed on its own.
        """
        root = self._compose()
        references = Counter[int]()
        _count_references(root, references)
        return tuple(self._locate(root, key, references) for key in keys)

    def with_values(self, spelling: Mapping[str, str]) -> YamlDocument:
        """The same text with other numbers at some dotted paths, read back by two parsers.

        Args:
            spelling: the new number, as text, by dotted path.

        Raises:
            ControllerUnfit: as `locate`, or the new text does not say what was meant and nothing else.
        """
        changed = YamlDocument(self.name, spliced(self.text, self.locate(tuple(spelling)), spelling))
        changed.check_against(self, spelling)
        return changed

    def check_against(self, before: YamlDocument, spelling: Mapping[str, str]) -> None:
        """Refuse unless this file differs from `before` in the named numbers alone, for both parsers.

        ruamel.yaml reads YAML 1.2 and PyYAML reads YAML 1.1: whichever the controller uses, it sees the same.

        Raises:
            ControllerUnfit: it differs in more, or in less.
        """
        targets = {tuple(key.split(".")): number for key, number in spelling.items()}
        for leaves in (_leaves_1_2, _leaves_1_1):
            check_leaves(self.name, leaves(before), leaves(self), targets)
        check_text(self.name, self.text, spliced(before.text, before.locate(tuple(spelling)), spelling))

    def _compose(self) -> Node:
        try:
            root: Node | None = YAML(typ="safe", pure=True).compose(self.text)
        except (YAMLError, ValueError, RecursionError) as error:
            raise ControllerUnfit(
                self.name,
                found=f"no YAML ({' '.join(str(error).split())[:200]})",
                expected="one YAML document",
                remedy="correct the file; nothing was written",
            ) from error
        if root is None:
            raise ControllerUnfit(
                self.name,
                found="an empty file",
                expected="the controller's parameters",
                remedy="is this the right file?",
            )
        return root

    def _locate(self, root: Node, key: str, references: Counter[int]) -> Scalar:
        node = root
        walked: KeyPath = ()
        for step in key.split("."):
            node = self._child(node, step, key, walked)
            walked = (*walked, step)
            # A value that another place refers to by an alias cannot be changed without changing that place too.
            if references[id(node)] > 1:
                raise unfit(
                    self.name, key, f"{'.'.join(walked)} shared by an anchor (&) and its alias (*)", "write it out"
                )
        if not isinstance(node, ScalarNode):
            raise unfit(self.name, key, "a list or mapping", "name the key of a number")
        quote = node.style or ""
        end = node.end_mark.index - len(quote)
        start = end - len(node.value)
        # An anchor or a tag may stand before the number; an escape within quotes makes its text another than its value.
        opened = self.text[start - 1 : start] == quote if quote else self._begins(node, start)
        if not opened or self.text[start:end] != node.value or not _NUMBER.fullmatch(node.value):
            raise unfit(self.name, key, f"{node.value!r:.60}", "write a plain decimal number")
        return Scalar(key, float(node.value), node.value, start, end, node.start_mark.line + 1)

    def _begins(self, node: ScalarNode, start: int) -> bool:
        return start == node.start_mark.index or self.text[start - 1].isspace()

    def _child(self, node: Node, step: str, key: str, walked: KeyPath) -> Node:
        place = ".".join(walked) or "the file"
        if isinstance(node, SequenceNode) and step.isdecimal() and int(step) < len(node.value):
            child: Node = node.value[int(step)]
            return child
        if not isinstance(node, MappingNode):
            raise unfit(self.name, key, f"no key {step!r} in {place}", CORRECT_KEY)
        found: list[Node] = [value for name, value in node.value if isinstance(name, ScalarNode) and name.value == step]
        if len(found) > 1:
            raise unfit(self.name, key, f"{step!r} {len(found)} times in {place}", "remove all but one")
        if not found:
            names = [str(name.value) for name, _ in node.value if isinstance(name, ScalarNode)]
            if _MERGE in names:
                raise unfit(
                    self.name, key, f"no {step!r} of its own in {place}, which merges (<<) another", "write it out"
                )
            has = ", ".join(names[:12]) or "nothing"
            raise unfit(self.name, key, f"no key {step!r} in {place} (it has {has})", CORRECT_KEY)
        return found[0]


def yaml_document(content: bytes, name: str) -> YamlDocument:
    """A YAML document from its bytes.

    Raises:
        ControllerUnfit: they are not UTF-8.
    """
    try:
        return YamlDocument(name, content.decode())
    except UnicodeDecodeError as error:
        raise ControllerUnfit(
            name,
            found=f"byte {error.start} that is not UTF-8",
            expected="YAML in UTF-8",
            remedy="save the file as UTF-8; nothing was written",
        ) from error


def _count_references(node: Node, references: Counter[int]) -> None:
    """Count from how many places each node is reached: more than once means an alias."""
    references[id(node)] += 1
    if references[id(node)] > 1:
        return
    if isinstance(node, MappingNode):
        for name, value in node.value:
            _count_references(name, references)
            _count_references(value, references)
    elif isinstance(node, SequenceNode):
        for child in node.value:
            _count_references(child, references)


def _leaves_1_2(file: YamlDocument) -> dict[KeyPath, str]:
    return _leaves(file._compose())


def _leaves_1_1(file: YamlDocument) -> dict[KeyPath, str]:
    try:
        return _leaves(yaml.compose(file.text, Loader=yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise ControllerUnfit(
            file.name,
            found=f"no YAML 1.1 ({' '.join(str(error).split())[:200]})",
            expected="one YAML document that readers of both YAML 1.1 and 1.2 understand",
            remedy="correct the file; nothing was written",
        ) from error


def _leaves(root: Any) -> dict[KeyPath, str]:
    """Every scalar of a tree by its path, and the size of every list and mapping.

    The two parsers have unrelated node classes whose parts have the same names. A node that an alias repeats is
    followed once: it is the same text.
    """
    leaves: dict[KeyPath, str] = {}
    seen: set[int] = set()
    waiting: list[tuple[KeyPath, Any]] = [((), root)]
    while waiting:
        path, node = waiting.pop()
        if id(node) in seen:
            leaves[path] = "*"
        elif isinstance(node.value, str):
            leaves[path] = node.value
        elif type(node).__name__ == "SequenceNode":
            leaves[*path, "[]"] = str(len(node.value))
            waiting.extend(((*path, str(position)), child) for position, child in enumerate(node.value))
        else:
            leaves[*path, "{}"] = str(len(node.value))
            for position, (name, value) in enumerate(node.value):
                step = name.value if isinstance(name.value, str) else f"? {position}"
                waiting.append(((*path, step), value))
        seen.add(id(node))
    return leaves
