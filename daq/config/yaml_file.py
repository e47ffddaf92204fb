"""Strict YAML: misspelt or duplicate keys and wrong types are refused with their line,
never guessed.

A document has one schema: a `StrictModel` for the whole file, whose sections are plain frozen
dataclasses wherever the file and the program mean the same. pydantic checks these dataclasses as
strictly as the model they are in, and a constraint (`Annotated[float, Field(gt=0)]`) is part of the
field's type. A section has a second class only where the program's shape differs: other units,
absolute paths, objects of another package.

A file that was given in the place of another is named by its kind (`DocumentKind`).
"""

from __future__ import annotations

import codecs
import dataclasses
import difflib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar, cast, get_args, get_type_hints

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo

from daq.config.foreign_files import foreign_kind
from daq.errors import (
    ConfigurationMissing,
    DaqError,
    SchemaMismatch,
    YamlInvalid,
    first_few,
    reason_of,
)
from daq.files import follow_links, read_regular

Location = tuple[str | int, ...]
MAX_BYTES = 4 * 2**20  #: Largest configuration [bytes]
MAX_DEPTH = 40  #: Deepest nesting; more takes time and memory beyond the size of the file
#: Largest number of keys and values; the largest shipped configuration has a hundredth of that
MAX_VALUES = 50_000
MAX_BITS = 64  #: Longest integer: no object of an amplifier is longer
#: Faults for which the nearest known key is searched; a hostile file has tens of thousands
MAX_EXPLAINED = 100
MAX_SHOWN = 8  #: Faults listed in one message
_NOT_IN_FILE = "\0"
#: Characters that end a line in YAML 1.1, and that editors do not show
_HIDDEN_LINE_END = re.compile("[\u0085\u2028\u2029]")

PATTERNS = {
    r"^[\w][\w .()/+-]*$": "letters, digits, spaces and _ . ( ) / + -, beginning with a letter, a "
    "digit or _",
    r"^[^\x00]+$": "text without the character NUL",
    r"^[^/\\\x00]+$": "the name of a file, without a folder",
    r"^[a-z0-9][a-z0-9_-]*$": "lower-case letters, digits, _ and -, beginning with a letter or a "
    "digit",
    r"^J[1-9][0-9]?$": "the name of a joint, J1 to J99",
    r"^[.,]$": "a point or a comma",
}
"""What each pattern of a text in the schemas allows, in words for a message."""
Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[\w][\w .()/+-]*$")]
FileName = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00]+$")]
Positive = Annotated[float, Field(gt=0)]


def _beside(name: str, info: ValidationInfo) -> Path:
    if info.context is None:
        return Path(name)
    try:
        return follow_links(info.context / name)
    except OSError as error:
        raise ValueError(f"a path without {error.strerror}") from error


if TYPE_CHECKING:
    FilePath = Path
else:
    FilePath = Annotated[FileName, AfterValidator(_beside)]
    """A path relative to the file that names it.

    It is absolute where `read_model` knows the folder of that file.
    """


class DocumentKind(Enum):
    """Kind of a document, as a message names it."""

    CELL = "a cell file"
    PLAN = "a plan of moves"
    CALIBRATION = "a calibration"
    RESIDUAL = "the numbers of a residual report"
    DRIVE_PROFILE = "a drive profile"
    DRIVE_RECORD = "a record of a write to drives"
    IMPORT = "an import description"
    SIMULATION = "a simulation file"
    SCENARIO = "a scenario of faults"
    LOG = "a log (MCAP)"
    URDF = "a URDF"


FORMATS = {
    "drivegain-plan": DocumentKind.PLAN,
    "drivegain-calibration": DocumentKind.CALIBRATION,
    "drivegain-residual": DocumentKind.RESIDUAL,
    "drivegain drive record 1": DocumentKind.DRIVE_RECORD,
}
"""Kinds whose files say it themselves, by the value of `format`."""
KEYS = {
    DocumentKind.CELL: {"robot", "drive_train", "axes"},
    DocumentKind.DRIVE_PROFILE: {"position", "current", "current_scale"},
    DocumentKind.IMPORT: {"cell", "position", "current"},
    DocumentKind.SIMULATION: {"urdf", "ratio", "axes"},
    DocumentKind.SCENARIO: {"faults"},
}
"""Keys that a file of a kind has, and of those before it no other;
the first kind that fits counts.
"""
MAGIC_OF_LOGS = b"\x89MCAP"


def kind_of_tree(tree: object) -> DocumentKind | None:
    """Return the kind of a parsed document; None for one of no known kind."""
    if not isinstance(tree, Mapping):
        return None
    stated = tree.get("format")
    if isinstance(stated, str) and stated in FORMATS:
        return FORMATS[stated]
    return next((kind for kind, keys in KEYS.items() if keys <= tree.keys()), None)


def kind_of_head(content: bytes) -> DocumentKind | None:
    """Return the kind of a file that is no YAML, by its first bytes;
    None for one of no known kind.
    """
    if content.startswith(MAGIC_OF_LOGS):
        return DocumentKind.LOG
    head = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if head.startswith(b"<") and b"<robot" in head:
        return DocumentKind.URDF
    return None


#: Remedy for a file in the place of another
IN_ORDER = "give the files in the order of the command's help"


class StrictModel(BaseModel):
    """Schema of a whole file, and of its sections: no unknown keys, no conversions, no NaN.

    A schema is built when its first document is read: most programs read few of the kinds.
    """

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True
    )
    #: page of docs/reference with every key, for a file that people write
    reference: ClassVar[str] = ""
    document_kind: ClassVar[DocumentKind | None] = (
        None  #: of a whole file; None for a section, and for a file of programs alone
    )


Model = TypeVar("Model", bound=StrictModel)


@dataclass(frozen=True, slots=True)
class Document:
    """A parsed file."""

    name: str  #: name in messages
    tree: Any  #: mappings, lists and scalars
    lines: dict[Location, int]  #: line number of every value, from 1, by its path

    def where(self, path: Location) -> str:
        """Return 'FILE:LINE: axes[3].limits', with the line of the nearest ancestor that is in the
        file.
        """
        known = path
        while known not in self.lines and known:
            known = known[:-1]
        line = self.lines.get(known)
        place = f"{self.name}:{line}" if line else self.name
        return f"{place}: {yaml_text(path)}"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault at one place of a file."""

    path: Location
    found: str
    expected: str


class _Loader(yaml.CSafeLoader):
    """YAML 1.2 core scalars only: `no` is text and 1e-6 a number, unlike in YAML 1.1."""


_Loader.yaml_implicit_resolvers = {}

_CORE_SCALARS = (
    ("null", r"(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"(?:[-+]?(?:0|[1-9][0-9]*)|0x[0-9a-fA-F]+)$", list("-+0123456789")),
    (
        "float",
        r"(?:[-+]?(?:(?:\.[0-9]+|[0-9]+\.[0-9]*)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+|\.(?:inf|Inf|INF))"
        r"|\.(?:nan|NaN|NAN))$",
        list("-+0123456789."),
    ),
)
for _tag, _pattern, _first in _CORE_SCALARS:
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)
_TAGS = {
    f"tag:yaml.org,2002:{tag}" for tag in ("null", "bool", "int", "float", "str", "map", "seq")
}


@lru_cache(maxsize=16)
def parse_yaml(text: bytes, name: str) -> Document:
    """Parse one YAML document.

    A cell reads its files for their names, their content and their digest: once is enough.

    Args:
        text: content of the file.
        name: name of the file in messages.

    Raises:
        YamlInvalid: not a single YAML document; duplicate keys, aliases, tags or keys that are not
            text; too large, too deep, or too many values.
    """
    if len(text) > MAX_BYTES:
        raise YamlInvalid(
            name,
            found=f"{len(text)} bytes",
            expected=f"a configuration of at most {MAX_BYTES} bytes",
            remedy="is this the right file?",
        )
    other = kind_of_head(text)
    if other is not None:
        raise YamlInvalid(name, found=other.value, expected="a file in YAML", remedy=IN_ORDER)
    foreign = foreign_kind(text)
    if foreign is not None:
        raise YamlInvalid(
            name, found=foreign.value, expected="a file in YAML", remedy=foreign.remedy
        )
    _check_encoding(text, name)
    lines: dict[Location, int] = {}
    try:
        _check_events(text, name)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                tree = None
            else:
                tree = _convert(loader, node, (), name, lines)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = _line(error.problem_mark or error.context_mark)
        found = (error.problem or error.context or "broken YAML").removeprefix("found ")
        remedy = "mind indentation (spaces, no tabs), colons and quotes; is this the right file?"
        if found == "but found another document":
            found = "a second document, behind `---`"
            remedy = "remove this line and what is below it, or give that a file of its own"
        hidden = _HIDDEN_LINE_END.search(text.decode("utf-8", errors="replace"))
        if hidden is not None:
            code_point = f"U+{ord(hidden[0]):04X}"
            found = f"{found}; the file has an invisible character that ends a line, {code_point}"
            remedy = "remove that character: it comes with text from a page or a document"
        raise YamlInvalid(
            f"{name}:{line}", found=found, expected="one YAML document", remedy=remedy
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        kind = type(error).__name__
        reason = str(error).splitlines()[0] if str(error) else "nesting too deep"
        raise YamlInvalid(
            name,
            found=f"{kind}: {reason}",
            expected="one YAML document in UTF-8",
            remedy="is this the right file?",
        ) from error
    return Document(name, tree, lines)


def _check_encoding(text: bytes, name: str) -> None:
    """Refuse bytes that are no UTF-8, with their line; libyaml has no place for them.

    Raises:
        YamlInvalid: a byte is in another encoding. UTF-16 with its mark is left to libyaml.
    """
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return
    try:
        text.decode("utf-8")
    except UnicodeDecodeError as error:
        line = text.count(b"\n", 0, error.start) + 1
        raise YamlInvalid(
            f"{name}:{line}",
            found=f"byte 0x{text[error.start]:02x}, which is no UTF-8 there",
            expected="one YAML document in UTF-8",
            remedy="save the file as UTF-8; is this the right file?",
        ) from error


def _check_events(text: bytes, name: str) -> None:
    """Refuse aliases, deep nesting and very many values while nothing is built of them.

    A few lines of aliases can unfold to gigabytes; the other two take minutes.

    Raises:
        YamlInvalid: there is one of them.
        yaml.YAMLError, ValueError: it is no YAML.
    """
    for event, depth, values in yaml_events(text):
        where = f"{name}:{_line(event.start_mark)}"
        if isinstance(event, yaml.AliasEvent):
            raise YamlInvalid(
                where,
                found="an alias (*name)",
                expected="plain values",
                remedy="write the value out",
            )
        if depth > MAX_DEPTH:
            found = f"more than {MAX_DEPTH} lists in lists"
            raise YamlInvalid(
                where, found=found, expected="plain values", remedy="is this the right file?"
            )
        if values > MAX_VALUES:
            found = f"more than {MAX_VALUES} values"
            raise YamlInvalid(
                where, found=found, expected="a configuration", remedy="is this the right file?"
            )


def yaml_events(text: bytes) -> Iterator[tuple[yaml.Event, int, int]]:
    """Yield each event of a YAML text, with the depth of nesting and the number of keys and values
    so far.

    libyaml needs a fraction of a second for a text of which a tree would take minutes.

    Raises:
        yaml.YAMLError, ValueError: it is no YAML.
    """
    depth = 0
    values = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if isinstance(event, yaml.NodeEvent):
            values += 1
        yield event, depth, values


def _line(mark: Any) -> int | str:
    """Line of a mark of libyaml, from 1."""
    return "?" if mark is None else mark.line + 1


def not_in_file(kind: str) -> str:
    """Return the tag of one kind of value where a key allows several:
    a part of pydantic's path, not of the file's.
    """
    return _NOT_IN_FILE + kind


def kind_of_file(path: Path) -> DocumentKind | None:
    """Return the kind of a file, for a message;
    None for one that cannot be read, and for one of no known kind.
    """
    try:
        content = read_regular(path, MAX_BYTES)
    except OSError:
        return None
    known = kind_of_head(content)
    if known is not None:
        return known
    try:
        return kind_of_tree(parse_yaml(content, str(path)).tree)
    except YamlInvalid:
        return None


def read_yaml_bytes(path: Path) -> bytes:
    """Read a configuration file of at most MAX_BYTES.

    Raises:
        ConfigurationMissing: the file does not exist, is not a regular file, is too large, or
            cannot be read.
    """
    return read_file(
        path,
        ConfigurationMissing,
        expected=f"a readable, regular file of at most {MAX_BYTES} bytes",
        remedy="check the name; it is relative to the file that names it, on a command line to the "
        "current folder",
    )


def read_file(path: Path, missing: type[DaqError], *, expected: str, remedy: str) -> bytes:
    """Read a file of at most MAX_BYTES that a person named; a pipe or device is not waited for.

    Raises:
        DaqError: of the class `missing`, where it does not exist, is no regular file, is too large,
            or cannot be read.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except OSError as error:
        found = reason_of(error)
        raise missing(str(path), found=found, expected=expected, remedy=remedy) from error


def read_model(document: Document, model: type[Model], folder: Path | None = None) -> Model:
    """Check a document against its schema.

    Args:
        document: a parsed file.
        model: its schema.
        folder: folder of the file, which makes each `FilePath` in it absolute.

    Raises:
        SchemaMismatch: with every unknown key, missing key and wrong type, its line and the nearest
            known key.
    """
    try:
        # Through JSON, where a list may become a tuple and a word an enum although everything else
        # is strict.
        return model.model_validate_json(json.dumps(document.tree), context=folder)
    except ValidationError as error:
        page = ""
        if model.reference:
            page = f"; docs/reference/{model.reference} has every key"
        kind = kind_of_tree(document.tree)
        if model.document_kind is not None and kind not in (None, model.document_kind):
            raise SchemaMismatch(
                document.name,
                found=kind.value,
                expected=model.document_kind.value,
                remedy=f"{_right_order(model)}{page}",
            ) from error
        required = [name for name, field in model.model_fields.items() if field.is_required()]
        keys = list(document.tree) if isinstance(document.tree, dict) else required
        if len(required) > 1 and not set(keys) & set(required):
            listed = ", ".join(keys[:MAX_EXPLAINED]) or "no key"
            expected = ", ".join(required)
            raise SchemaMismatch(
                document.name,
                found=f"a file of another kind, with {listed}",
                expected=f"a file with {expected}",
                remedy=f"{_right_order(model)}{page}",
            ) from error
        items = error.errors(include_url=False)
        found_faults = [_fault(item, model, document.tree) for item in items[:MAX_EXPLAINED]]
        faults = _joined_faults(found_faults)
        # A list counts as empty when its items are wrong; the faults inside say enough.
        outer = set[Location]()
        for fault in faults:
            outer.update(fault.path[:length] for length in range(len(fault.path)))
        remedy = f"correct the file{page}"
        if len(items) > MAX_EXPLAINED:
            remedy += f" ({len(items) - MAX_EXPLAINED} more faults are not listed)"
        inner = [fault for fault in faults if fault.path not in outer]
        raise SchemaMismatch(**fault_texts(document, inner), remedy=remedy) from error


def _right_order(model: type[StrictModel]) -> str:
    """What to do about a file of another kind: `simulate` alone takes no CELL."""
    if model.document_kind in {DocumentKind.SIMULATION, DocumentKind.SCENARIO}:
        return IN_ORDER
    return f"{IN_ORDER} (CELL comes first)"


def fault_texts(document: Document, faults: list[Fault]) -> dict[str, str]:
    """Return subject, found and expected of an error with these faults, one a line."""
    if len(faults) == 1:
        only = faults[0]
        return {
            "subject": document.where(only.path),
            "found": only.found,
            "expected": only.expected,
        }
    new_line = "\n  "
    texts = []
    for fault in faults:
        place = document.where(fault.path)
        texts.append(f"{place}: found {fault.found}; expected {fault.expected}")
    listed = first_few(texts, MAX_SHOWN, separator=new_line)
    return {
        "subject": document.name,
        "found": f"{len(faults)} faults{new_line}{listed}",
        "expected": "none",
    }


def yaml_text(path: Location) -> str:
    """Write a path as axes[3].limits.velocity_deg_s (counted from 0)."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.lstrip(".") or "the whole file"


def _convert(
    loader: _Loader, node: yaml.Node, path: Location, name: str, lines: dict[Location, int]
) -> Any:
    """Convert a node to plain Python and note its lines;
    refuse YAML features that a configuration must not use.
    """
    line = node.start_mark.line + 1
    lines[path] = line
    if node.tag not in _TAGS:
        tag = node.tag.removeprefix("tag:yaml.org,2002:")
        raise YamlInvalid(
            f"{name}:{line}: {yaml_text(path)}",
            found=f"tag {tag}",
            expected="plain text, numbers, lists and mappings",
            remedy="remove the tag",
        )
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                key = loader.construct_object(key_node)
                shown = f"key {key_node.value!r}"
            else:
                key = None
                shown = f"a {key_node.id} as a key"
            key_line = key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise YamlInvalid(
                    f"{name}:{key_line}: {yaml_text(path)}",
                    found=shown,
                    expected="a key that is text",
                    remedy="quote it if this is intended",
                )
            if key in mapping:
                first_line = lines[*path, key]
                raise YamlInvalid(
                    f"{name}:{key_line}: {yaml_text((*path, key))}",
                    found=f"duplicate key {key!r}, first on line {first_line}",
                    expected="each key once",
                    remedy="remove one of them",
                )
            mapping[key] = _convert(loader, value_node, (*path, key), name, lines)
            lines[*path, key] = key_line
        return mapping
    if isinstance(node, yaml.SequenceNode):
        values = []
        for index, child in enumerate(node.value):
            values.append(_convert(loader, child, (*path, index), name, lines))
        return values
    value = loader.construct_object(node)
    if isinstance(value, int) and value.bit_length() > MAX_BITS:
        raise YamlInvalid(
            f"{name}:{line}: {yaml_text(path)}",
            found=f"an integer of {value.bit_length()} bits",
            expected=f"at most {MAX_BITS}",
            remedy="was a digit held down, or is this text? then quote it",
        )
    return value


def _joined_faults(faults: list[Fault]) -> list[Fault]:
    """Join the faults of one value that may be of several kinds, none of which it is."""
    joined: dict[tuple[Location, str], list[str]] = {}
    for fault in faults:
        expected = joined.setdefault((fault.path, fault.found), [])
        if fault.expected not in expected:
            expected.append(fault.expected)
    return [
        Fault(path, found, ", or ".join(expected)) for (path, found), expected in joined.items()
    ]


def _path_in_file(item: Any, tree: Any) -> Location:
    """Return where in the file a validation error is.

    Where a value may be of several kinds, pydantic's path has a name for each of them; that is no
    part of the file.
    """
    path: list[str | int] = []
    here = tree
    parts = [part for part in item["loc"] if not str(part).startswith(_NOT_IN_FILE)]
    for place, part in enumerate(parts):
        is_last = place == len(parts) - 1
        is_key = isinstance(here, dict) and part in here
        is_index = isinstance(here, list) and isinstance(part, int) and part < len(here)
        is_there = is_key or is_index
        is_missing_key = is_last and item["type"] == "missing"
        if is_there or is_missing_key:
            path.append(part)
        if is_there:
            here = here[part]
    return tuple(path)


def _fault(item: Any, model: type[BaseModel], tree: Any) -> Fault:
    """Translate a validation error of pydantic to found and expected."""
    path = _path_in_file(item, tree)
    if item["type"] in {"extra_forbidden", "unexpected_keyword_argument"}:
        known = _known_keys(model, path[:-1])
        near = difflib.get_close_matches(str(path[-1]), known, n=1, cutoff=0.5)
        if near:
            hint = f"{near[0]} (did you mean that?)"
        else:
            hint = f"one of {', '.join(known)}"
        return Fault(path, f"unknown key {path[-1]!r}", hint)
    if item["type"] == "missing":
        return Fault(path, "nothing", "this key, it is required")
    if item["type"] == "string_pattern_mismatch":
        pattern = item["ctx"]["pattern"]
        return Fault(path, _show(item["input"]), PATTERNS.get(pattern, f"text like {pattern}"))
    expected = re.sub(
        r"^\w+ should (be|have) |^Value error, | after "
        r"validation, not .*$",
        "",
        item["msg"],
    )
    return Fault(path, _show(item["input"]), expected)


def _show(value: Any) -> str:
    kinds = {
        str: "text",
        bool: "truth value",
        int: "integer",
        float: "number",
        list: "list",
        dict: "mapping",
    }
    kind = kinds.get(type(value), "nothing")
    text = json.dumps(value)
    if len(text) > 60:
        text = f"{text[:57]}..."
    return f"{kind} {text}"


def _known_keys(model: type[BaseModel], path: Location) -> list[str]:
    """List the keys that the schema has at a path;
    list positions and names of a free mapping are skipped.
    """
    current: type[Any] = model
    for part in path:
        if isinstance(part, str) and part in (keys := _keys(current)):
            current = _nested(keys[part]) or current
    return list(_keys(current))


def _keys(section: type[Any]) -> dict[str, Any]:
    """Annotations of a section's fields, by name."""
    if issubclass(section, BaseModel):
        return {name: info.annotation for name, info in section.model_fields.items()}
    hints = get_type_hints(section)
    return {field.name: hints[field.name] for field in dataclasses.fields(section)}


def _nested(annotation: Any) -> type[Any] | None:
    """Find the first section in an annotation such as `tuple[Section, ...] | None`."""
    is_class = isinstance(annotation, type)
    if is_class and (dataclasses.is_dataclass(annotation) or issubclass(annotation, BaseModel)):
        return cast("type[Any]", annotation)
    found = (_nested(argument) for argument in get_args(annotation))
    return next((section for section in found if section is not None), None)
