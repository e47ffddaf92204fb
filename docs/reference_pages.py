"""Text of the reference pages that is made of the code, and a Sphinx extension that refuses a page that lags behind.

    python -m docs.reference_pages            writes it into the pages, and the JSON schemas into docs/reference/schemas
    python -m docs.reference_pages --check    names the files that are not up to date

A page has a part between the lines ``<!-- generated: NAME -->`` and ``<!-- generated until here -->``; `PARTS` maps
each name to a function that returns Markdown.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer
from pydantic import TypeAdapter
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from daq.cli.app import build_app
from daq.cli.verb import help_record
from daq.config.cell_schema import CellModel
from daq.config.drive import DriveModel
from daq.config.import_description import ImportDescription
from daq.documents.calibration_file import CalibrationDocument
from daq.errors import DaqError, exit_code
from daq.report.document import ErrorReport
from daq.report.schemas import REPORTS
from daq.simulation.simulation_file import SimulationModel
from daq.writeback.gates.table import GATES
from drivers.errors import DriverError
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect
from ident.errors import IdentificationError

SCHEMAS: dict[str, tuple[str, Any]] = {
    "cell": ("Cell file", CellModel),
    "drive-profile": ("Drive profile", DriveModel),
    "calibration": ("Calibration", CalibrationDocument),
    "import": ("Import description", ImportDescription),
    "simulation": ("Simulation file", SimulationModel),
    "error": ("Error of any verb under --json", ErrorReport),
    **{
        f"report-{verb}": (f"What {verb} prints under --json", model)
        for verb, model in REPORTS.items()
    },
}
"""Title and model of each schema, by its name."""
FRONT_DOORS = ("ident", "daq", "drivers")
API_PAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "data": ("ident", ("data.", "arrays.", "equations.")),
    "model": ("ident", ("model.",)),
    "identify": ("ident", ("estimators.", "physical.")),
    "effects": ("ident", ("effects.", "discovery.")),
    "calibration": ("ident", ("calibration.", "prediction.")),
    "weighing": ("ident", ("weighing.", "contact.")),
    "planning": ("ident", ("planning.",)),
    "errors": ("ident", ("errors.",)),
    "daq": ("daq", ("",)),
    "drivers": ("drivers", ("",)),
}
"""Package, and rooms of it, that each page of the API describes."""
NO_DOCSTRING = {
    "ident.FloatArray": "A numpy array of float64.",
    "drivers.CIA402": "The drive profile of CiA 402, without what a maker adds.",
}
"""What exported values are, which have no docstring of their own."""
HERE = Path(__file__).resolve().parent
SCHEMA_FOLDER = HERE / "reference" / "schemas"
UNTIL = "<!-- generated until here -->"
MARK = re.compile(
    rf"^(<!-- generated: ([a-z ]+) -->)\n.*?^{re.escape(UNTIL)}$", re.MULTILINE | re.DOTALL
)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hooks."""
    app.connect("source-read", _require_current)
    app.connect("build-finished", _publish_schemas)
    # Before napoleon (priority 500), which adds markup of its own.
    app.connect("autodoc-process-docstring", _escape_docstring, priority=400)
    app.connect("autodoc-process-signature", _shorten_types)
    return {"parallel_read_safe": True}


def filled(page: str) -> str:
    """The text of a page with its generated parts as the code has them now."""
    return MARK.sub(lambda mark: f"{mark[1]}\n\n{PARTS[mark[2]]()}\n\n{UNTIL}", page)


def schema_texts() -> dict[str, str]:
    """The JSON schemas, by the names of their files."""
    texts = {}
    for name, (title, model) in SCHEMAS.items():
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **_schema(model),
            "title": title,
        }
        _unwrap_descriptions(schema)
        texts[f"{name}.json"] = json.dumps(schema, indent=1, ensure_ascii=False) + "\n"
    return texts


def _unwrap_descriptions(node: Any) -> None:
    """Make each description one paragraph: docstrings break their lines for an editor's sake."""
    if isinstance(node, list):
        for item in node:
            _unwrap_descriptions(item)
    elif isinstance(node, dict):
        for key, item in node.items():
            if key == "description" and isinstance(item, str):
                node[key] = " ".join(item.split())
            else:
                _unwrap_descriptions(item)


def lagging() -> dict[Path, str | None]:
    """Files that are not as the code has them, with the text that they should have; None: the file should go."""
    wanted = {path: filled(path.read_text(encoding="utf-8")) for path in sorted(HERE.rglob("*.md"))}
    schemas = {SCHEMA_FOLDER / name: text for name, text in schema_texts().items()}
    texts = {**wanted, **schemas}
    found: dict[Path, str | None] = {
        path: text for path, text in texts.items() if not _is_current(path, text)
    }
    found.update({path: None for path in SCHEMA_FOLDER.glob("*.json") if path not in schemas})
    return found


def _is_current(path: Path, text: str) -> bool:
    return path.exists() and path.read_text(encoding="utf-8") == text


def _require_current(_app: Sphinx, name: str, source: list[str]) -> None:
    if filled(source[0]) != source[0]:
        raise ExtensionError(
            f"docs/{name}.md: its generated text is not that of the code; run `make reference`"
        )


def _publish_schemas(app: Sphinx, error: Exception | None) -> None:
    """Copy the schemas to the address that they have on the site."""
    if error is not None or app.builder.format != "html":
        return
    folder = Path(app.outdir) / "schemas"
    folder.mkdir(exist_ok=True)
    for name, text in schema_texts().items():
        (folder / name).write_text(text, encoding="utf-8")


def _escape_docstring(
    _app: Sphinx, _kind: str, _name: str, _object: Any, _options: Any, lines: list[str]
) -> None:
    """Take `|x|`, `a*b` and `name_` in a docstring for text, not for reStructuredText."""
    for number, line in enumerate(lines):
        parts = re.split(r"(``.+?``|`[^`]+`)", line)
        parts[::2] = [
            re.sub(r"(?<!\w)\*(?=\w)|(?<=\w)_(?!\w)|[|]|(?<=\w)\*", r"\\\g<0>", part)
            for part in parts[::2]
        ]
        parts[1::2] = [part if part.startswith("``") else f"`{part}`" for part in parts[1::2]]
        lines[number] = "".join(parts)


def _shorten_types(
    _app: Sphinx,
    _kind: str,
    _name: str,
    _object: Any,
    _options: Any,
    signature: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Write `FloatArray` and `NDArray[int64]` for the types that they are short for."""

    def short(text: str | None) -> str | None:
        if text is None:
            return None
        text = re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
        return re.sub(
            r"(?:~?numpy\.)?ndarray\[tuple\[.*?\], (?:~?numpy\.)?dtype\[(?:~?numpy\.)?(\w+)\]\]",
            r"NDArray[\1]",
            text,
        )

    return short(signature), short(returned)


# --- the command line


def command_line() -> str:
    """Every verb with its help, usage, arguments and options."""
    group: Any = typer.main.get_command(build_app())
    context = typer.Context(group, info_name="drivegain")
    verbs = [
        (name, group.resolve_command(context, [name])[1]) for name in group.list_commands(context)
    ]
    return "\n\n".join(
        _command(verb, f"drivegain {name}", context, level=2) for name, verb in verbs
    )


# typer brings a click of its own, whose classes have no public name; hence Any.
def _command(command: Any, name: str, parent: typer.Context, level: int) -> str:
    context = typer.Context(command, info_name=name.rpartition(" ")[2], parent=parent)
    usage = " ".join(command.collect_usage_pieces(context))
    parts = [
        f"{'#' * level} {name}",
        _paragraphs(command.help or ""),
        f"```text\n{name} {usage}\n```",
    ]
    records = [
        record
        for record in (help_record(one, context) for one in command.get_params(context))
        if record
    ]
    parts += [
        f"`{term.strip()}`\n: {_escaped(' '.join(text.split())) or '—'}" for term, text in records
    ]
    if command.epilog and "Example:" in command.epilog:
        example = command.epilog.partition("Example:")[2].strip()
        parts.append(f"Example:\n\n```console\n$ {example}\n```")
    kinds = getattr(command, "commands", {})
    parts += [
        _command(kind, f"{name} {kind_name}", context, level + 1)
        for kind_name, kind in kinds.items()
    ]
    return "\n\n".join(part for part in parts if part)


def _paragraphs(text: str) -> str:
    return "\n\n".join(
        _escaped(" ".join(part.split())) for part in inspect.cleandoc(text).split("\n\n")
    )


def _escaped(text: str) -> str:
    """Plain text as Markdown that shows exactly it."""
    return re.sub(r"([\\`*_{}\[\]<>#|$])", r"\\\1", text.replace("\b", ""))


# --- files


def cell_file() -> str:
    """Every section of a cell file: keys, types and defaults."""
    return _sections(_schema(CellModel))


def schema_list() -> str:
    """Links to the JSON schemas."""
    lines = [
        f"- [{name}.json](schemas/{name}.json): {title.lower()}"
        for name, (title, _) in SCHEMAS.items()
    ]
    return "\n".join(lines)


def _schema(model: Any) -> dict[str, Any]:
    """The schema of a model, with the comments at its fields (`#:`) as descriptions."""
    schema: dict[str, Any] = TypeAdapter(model).json_schema()
    classes: dict[str, type] = {}
    _collect_classes(model, classes)
    for name, section in [(schema.get("title", ""), schema), *schema.get("$defs", {}).items()]:
        if name not in classes:
            continue
        comments = field_comments(classes[name])
        for key, field in section.get("properties", {}).items():
            if key in comments:
                field.setdefault("description", comments[key])
    return schema


def _collect_classes(kind: Any, found: dict[str, type]) -> None:
    """Collect the classes with fields that a type is made of, by name."""
    for part in get_args(kind):
        _collect_classes(part, found)
    has_fields = is_dataclass(kind) or hasattr(kind, "model_fields")
    if not inspect.isclass(kind) or not has_fields or kind.__name__ in found:
        return
    found[kind.__name__] = kind
    for hint in get_type_hints(kind, include_extras=True).values():
        _collect_classes(hint, found)


def field_comments(kind: type) -> dict[str, str]:
    """The comments `#:` after or above the fields of a class and its bases, as sentences."""
    comments: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not base.__module__.startswith(FRONT_DOORS):
            continue
        lines = inspect.cleandoc("\n" + inspect.getsource(base)).splitlines()
        (tree,) = ast.parse("\n".join(lines)).body
        for node in ast.iter_child_nodes(tree):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                text = _comment_of(lines, node)
                if text:
                    sentence = text[0].upper() + text[1:].rstrip(".") + "."
                    comments[node.target.id] = re.sub(r"\bNone\b", "null", sentence)
    return comments


def _comment_of(lines: Sequence[str], node: ast.AnnAssign) -> str:
    """The comment of a field, after its last line or above its first; empty without one."""
    last = lines[(node.end_lineno or node.lineno) - 1]
    behind = last[node.end_col_offset :].partition("#:")[2].strip()
    if behind:
        return behind
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        above.insert(0, line.strip().removeprefix("#:").strip())
    return " ".join(above)


def _sections(schema: dict[str, Any]) -> str:
    definitions: dict[str, Any] = schema.get("$defs", {})
    sections: list[tuple[str, str, dict[str, Any]]] = []
    seen: set[str] = set()

    def visit(path: str, reference: str | None, node: dict[str, Any]) -> None:
        if reference in seen:
            return
        if reference is not None:
            seen.add(reference)
        if "properties" in node:
            sections.append((path, reference or "", node))
        for key, child in node.get("properties", {}).items():
            inner = f"{path}.{key}" if path else key
            for name, many in _references(child):
                visit(inner + ("[]" if many else ""), name, definitions[name])

    visit("", None, schema)
    anchors = {reference: path for path, reference, _ in sections}
    return "\n\n".join(_section(path, node, anchors, definitions) for path, _, node in sections)


def _section(
    path: str, node: dict[str, Any], anchors: dict[str, str], definitions: dict[str, Any]
) -> str:
    lines = [
        f"## {f'`{path}`' if path else 'The whole file'}",
        _paragraphs(_first(node.get("description", ""))),
    ]
    rows = ["| key | value | default |", "| --- | --- | --- |"]
    required = set(node.get("required", ()))
    for key, child in node["properties"].items():
        default = "*required*" if key in required else _default(child.get("default"))
        meaning = _escaped(child["description"]) + " " if "description" in child else ""
        rows.append(f"| `{key}` | {meaning}{_value(child, anchors, definitions)} | {default} |")
    return "\n\n".join([*filter(None, lines), "\n".join(rows)])


def _first(description: str) -> str:
    """The paragraphs before the list of attributes."""
    return re.split(r"\n\s*Attributes:", inspect.cleandoc(description))[0]


def _references(node: Any, many: bool = False) -> Iterator[tuple[str, bool]]:
    if not isinstance(node, dict):
        return
    if "$ref" in node:
        yield node["$ref"].rpartition("/")[2], many
    for key in ("anyOf", "oneOf", "allOf", "prefixItems"):
        for child in node.get(key, ()):
            yield from _references(child, many)
    for key in ("items", "additionalProperties"):
        yield from _references(node.get(key), True)


def _value(node: dict[str, Any], anchors: dict[str, str], definitions: dict[str, Any]) -> str:
    """A schema in words."""
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        return (
            f"section `{anchors[name]}`"
            if name in anchors
            else _value(definitions[name], anchors, definitions)
        )
    for key in ("anyOf", "oneOf", "allOf"):
        if key in node:
            kinds = [
                _value(one, anchors, definitions) for one in node[key] if one.get("type") != "null"
            ]
            return " or ".join(dict.fromkeys(kinds))
    if "enum" in node or "const" in node:
        return ", ".join(f"`{one}`" for one in node.get("enum", [node.get("const")]))
    if node.get("type") in ("array", "object"):
        parts = node.get("prefixItems") or [
            node.get("items") or node.get("additionalProperties") or {}
        ]
        inner = ", ".join(dict.fromkeys(_value(one, anchors, definitions) for one in parts))
        size = (
            f"{len(parts)} ×"
            if "prefixItems" in node
            else "list of"
            if node["type"] == "array"
            else "mapping to"
        )
        return f"{size} {inner}"
    words = {
        "string": "text",
        "boolean": "`true` or `false`",
        "number": "number",
        "integer": "whole number",
    }
    bounds = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {node[key]}" for key, sign in bounds.items() if key in node]
    kind = node.get("type")
    return ", ".join(
        [words.get(kind, "anything") if isinstance(kind, str) else "anything", *limits]
    )


def _default(value: Any) -> str:
    if value is None or value in ({}, []):
        return "none"
    if isinstance(value, dict):
        return "the section's defaults"
    return f"`{json.dumps(value)}`"


# --- errors and the library


def errors() -> str:
    """Every error class under its exit code."""
    found: dict[int, list[type[BaseException]]] = {}
    for root in (DaqError, DriverError, IdentificationError):
        for one in _subclasses(root):
            found.setdefault(int(exit_code(one) or 1), []).append(one)
    parts = []
    for code, classes in sorted(found.items()):
        rows = [
            f"- `{one.__name__}`: {_escaped(_summary(one))}"
            for one in sorted(classes, key=lambda c: c.__name__)
        ]
        parts.append(f"### Exit code {code}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _subclasses(root: type[BaseException]) -> Iterator[type[BaseException]]:
    for child in root.__subclasses__():
        yield child
        yield from _subclasses(child)


def _summary(thing: Any) -> str:
    first_paragraph = (inspect.getdoc(thing) or "").partition("\n\n")[0]
    return " ".join(first_paragraph.split()).rstrip(".")


def api_names(page: str) -> tuple[str, ...]:
    """The exported names, with their package, that a page of the API describes."""
    package, _ = API_PAGES[page]
    names = []
    for name in sorted(importlib.import_module(package).__all__):
        home = _home(package, name)
        if home.startswith(f"{package}.") and _page_of(package, home) == page:
            names.append(f"{package}.{name}")
    return tuple(names)


def _home(package: str, name: str) -> str:
    """The module that a name comes from; a type alias has none of its own."""
    exported = getattr(importlib.import_module(package), name)
    module = str(getattr(exported, "__module__", ""))
    known = module.partition(".")[0] in FRONT_DOORS
    return (
        module if known else f"{package}.arrays" if package == "ident" else f"{package}.constants"
    )


def _page_of(package: str, module: str) -> str:
    """The page with the longest room that the module is in."""
    inside = module.removeprefix(f"{package}.")
    fitting = []
    for page, (owner, rooms) in API_PAGES.items():
        if owner == package:
            fitting += [(len(room), page) for room in rooms if f"{inside}.".startswith(room)]
    return max(fitting)[1]


def api(page: str) -> str:
    """Everything that a page of the API describes: functions, then classes."""
    rows = ["| name | |", "|---|---|"]
    functions: list[str] = []
    classes: list[str] = []
    others: list[str] = []
    for full_name in api_names(page):
        package, _, name = full_name.partition(".")
        exported = getattr(importlib.import_module(package), name)
        if inspect.isclass(exported):
            # Names of an enumeration say what they are, and have no docstrings.
            members = ":members:\n   :undoc-members:" if issubclass(exported, Enum) else ":members:"
            classes.append(f".. autoclass:: {full_name}\n   {members}")
        elif inspect.isfunction(exported):
            functions.append(f".. autofunction:: {full_name}")
        else:
            others.append(f".. py:data:: {full_name}\n\n   {NO_DOCSTRING[full_name]}")
        summary = NO_DOCSTRING.get(full_name) or _summary(exported)
        rows.append(f"| `{name}` | {_escaped(summary)} |")
    table = "\n".join(rows)
    directives = "\n\n".join([*functions, *classes, *others])
    return f"{table}\n\n```{{eval-rst}}\n{directives}\n```"


def gates() -> str:
    """Return the table of all gates, in the order in which they are checked."""
    head = "| gate | check | default limit | do |\n|---|---|---|---|\n"
    rows = [f"| {row.gate.value} | {row.text} | {row.limit} | {row.remedy} |" for row in GATES]
    return head + "\n".join(rows)


def effects() -> str:
    """Return the table of the effect dictionary, in the order in which the search tries it."""
    rows = ["| effect | torque | settings tried | signature |", "|---|---|---|---|"]
    for family in EFFECTS:
        text = " ".join((inspect.getdoc(type(family[0])) or "").split())
        signature = text.partition("Signature: ")[2].rstrip(".")
        cells = (f"`{family[0].name}`", _summary(type(family[0])), _settings(family), signature)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


def _settings(family: Sequence[Effect]) -> str:
    """Values of the searched parameters; of more than four only the range."""
    parts = []
    for name in family[0].settings:
        values = [f"{value:.3g}" for value in sorted({effect.settings[name] for effect in family})]
        parts.append(
            f"`{name}` "
            + (", ".join(values) if len(values) <= 4 else f"{values[0]} to {values[-1]}")
        )
    return "; ".join(parts)


PARTS: dict[str, Callable[[], str]] = {
    "command line": command_line,
    "cell file": cell_file,
    "schemas": schema_list,
    "errors": errors,
    **{f"api {page}": partial(api, page) for page in API_PAGES},
    "gates": gates,
    "effects": effects,
}
"""What a page can ask for."""


def main(arguments: Sequence[str]) -> int:
    """Write what lags behind, or with `--check` name it only."""
    found = lagging()
    SCHEMA_FOLDER.mkdir(exist_ok=True)
    for path, text in found.items():
        sys.stdout.write(f"{path.relative_to(HERE.parent)}\n")
        if "--check" in arguments:
            continue
        if text is None:
            path.unlink()
        else:
            path.write_text(text, encoding="utf-8")
    return int("--check" in arguments and bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
