"""`calibration.yaml`, the result of a fit: written whole, read strictly, and every edit by hand is detected.

The file adds percentages for people and writes NaN as null. Sections without such a difference (`Source`, `Recording`)
are read as the classes of `ident`.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from daq.config.yaml_file import MAX_BYTES, StrictModel, parse_yaml, read_model
from daq.errors import CalibrationMissing, CalibrationRefused, CalibrationUnreadable, SchemaMismatch, YamlInvalid
from daq.files import read_regular, replace_file
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter, Source
from ident.estimators.estimate import RelativeError

_Deviation = Annotated[float, Field(ge=0.0)]


class GainEntry(StrictModel):
    """One drive gain; the percentages are for people."""

    axis: str
    value: float
    std: _Deviation
    std_percent: float | None
    unit: str
    nameplate: float
    change_percent: float | None


class ParameterEntry(StrictModel):
    """One dynamic parameter or coefficient of an effect."""

    name: str
    value: float
    std: _Deviation
    std_percent: float | None
    unit: str


class RelativeErrorEntry(StrictModel):
    """Relative errors in percent; null for an axis that did not move."""

    axes: tuple[float | None, ...]
    total: float


class EffectEntry(StrictModel):
    """One accepted effect."""

    name: str
    axis: str
    settings: dict[str, float]
    coefficients: tuple[ParameterEntry, ...]
    error_before_percent: float
    error_after_percent: float
    ambiguity: tuple[str, ...]


class CalibrationDocument(StrictModel):
    """Schema of the whole file; the reader compares the `digests`."""

    format: Literal["drivegain-calibration"]
    version: int
    digests: dict[str, str]
    cell: str
    method: str
    gains: tuple[GainEntry, ...]
    parameters: tuple[ParameterEntry, ...]
    relative_error_percent: RelativeErrorEntry
    holdout_error_percent: RelativeErrorEntry | None
    condition: float
    rows: int
    filter: dict[str, int | float | list[float]]
    effects: tuple[EffectEntry, ...]
    sources: tuple[Source, ...]
    configuration_sha256: str
    created: str
    software: str
    session_began_s: float | None = None
    nameplate_holdout_error_percent: RelativeErrorEntry | None = None
    recording_configuration_sha256: str | None = None  #: Files of earlier versions lack these three


def _parameter(entry: ParameterEntry) -> Parameter:
    return Parameter(entry.name, entry.value, entry.std, entry.unit)


def _error(entry: RelativeErrorEntry) -> RelativeError:
    return RelativeError(tuple(math.nan if value is None else value for value in entry.axes), entry.total)


def _perhaps(entry: RelativeErrorEntry | None) -> RelativeError | None:
    return None if entry is None else _error(entry)


def calibration_of(entries: CalibrationDocument) -> Calibration:
    """Convert a checked document."""
    return Calibration(
        cell=entries.cell,
        method=entries.method,
        gains=tuple(Gain(g.axis, g.value, g.std, g.unit, g.nameplate) for g in entries.gains),
        parameters=tuple(_parameter(p) for p in entries.parameters),
        effects=tuple(
            AcceptedEffect(
                name=e.name,
                axis=e.axis,
                settings=dict(e.settings),
                coefficients=tuple(_parameter(c) for c in e.coefficients),
                error_before_percent=e.error_before_percent,
                error_after_percent=e.error_after_percent,
                ambiguity=e.ambiguity,
            )
            for e in entries.effects
        ),
        relative_error_percent=_error(entries.relative_error_percent),
        holdout_error_percent=_perhaps(entries.holdout_error_percent),
        condition=entries.condition,
        rows=entries.rows,
        filter=dict(entries.filter),
        sources=entries.sources,
        configuration_sha256=entries.configuration_sha256,
        created=entries.created,
        software=entries.software,
        session_began_s=entries.session_began_s,
        nameplate_holdout_error_percent=_perhaps(entries.nameplate_holdout_error_percent),
        recording_configuration_sha256=entries.recording_configuration_sha256,
    )


VERSION = 1
_ENVELOPE = ("format", "version", "digests")
_HEADER = """\
# Made by drivegain. Each section carries its digest:
# a file edited by hand is noticed, and nothing of it is written to a controller.
"""


class _Dumper(yaml.SafeDumper):
    """Quote words that YAML 1.2 reads as numbers: PyYAML writes YAML 1.1, where 1e6 is a word."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write equal sections twice: the reader refuses aliases."""
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    # Line breaks of Unicode (U+0085, U+2028) survive in double quotes only.
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _represent_text)
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$"),
    list("-+0123456789."),
)


def as_document(calibration: Calibration) -> dict[str, object]:
    """Return the calibration as lists, mappings and numbers: the object of `fit --json` and the body of the file.

    Percentages of zero are None.
    """
    return {
        "cell": calibration.cell,
        "method": calibration.method,
        "gains": [_gain_document(gain) for gain in calibration.gains],
        "parameters": [_parameter_document(parameter) for parameter in calibration.parameters],
        "effects": [
            {
                "name": effect.name,
                "axis": effect.axis,
                "settings": dict(effect.settings),
                "coefficients": [_parameter_document(coefficient) for coefficient in effect.coefficients],
                "error_before_percent": effect.error_before_percent,
                "error_after_percent": effect.error_after_percent,
                "ambiguity": list(effect.ambiguity),
            }
            for effect in calibration.effects
        ],
        "relative_error_percent": _error_document(calibration.relative_error_percent),
        "holdout_error_percent": _error_document(calibration.holdout_error_percent),
        "condition": calibration.condition,
        "rows": calibration.rows,
        "filter": {
            name: list(value) if isinstance(value, list) else value for name, value in calibration.filter.items()
        },
        "sources": [_source_document(source) for source in calibration.sources],
        "configuration_sha256": calibration.configuration_sha256,
        "created": calibration.created,
        "software": calibration.software,
        "session_began_s": calibration.session_began_s,
        "nameplate_holdout_error_percent": _error_document(calibration.nameplate_holdout_error_percent),
        "recording_configuration_sha256": calibration.recording_configuration_sha256,
    }


def save(calibration: Calibration, path: Path) -> None:
    """Write `calibration` to `path` atomically, and read it back before it replaces an older file.

    Raises:
        CalibrationUnreadable: a number is not finite; nothing is written.
        OSError: from the file system; an old file stays as it was.
    """

    def check(content: bytes) -> None:
        # Compared as documents: NaN, for an axis that did not move, is not equal to itself.
        if as_document(decode(content, str(path))) != as_document(calibration):
            raise CalibrationUnreadable(
                str(path),
                found="another content on reading back",
                expected="what was written",
                remedy="check the disk; the file was not replaced",
            )

    replace_file(path, encode(calibration), check=check)


def encode(calibration: Calibration) -> bytes:
    """Return the content of the file."""
    body = as_document(calibration)
    document = {"format": "drivegain-calibration", "version": VERSION, **body, "digests": _digests(body)}
    # One entry a line: leaf collections in flow style, lines never folded.
    text = yaml.dump(
        document, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf
    )
    return (_HEADER + text).encode()


def load(path: Path) -> Calibration:
    """Read a calibration.

    Raises:
        CalibrationMissing: the file does not exist, is a folder or a pipe, or cannot be read.
        CalibrationUnreadable: not a calibration of this version, or with a wrong key, type or number, with its line.
        CalibrationRefused: the content was edited, with the names of the edited sections.
    """
    return decode(read(path), str(path))


def read(path: Path) -> bytes:
    """Read the content of a calibration's file, for callers that also need its digest.

    Raises:
        CalibrationMissing: see `load`.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except OSError as error:
        raise CalibrationMissing(
            str(path),
            found=(error.strerror or type(error).__name__).lower(),
            expected="the file that `drivegain fit` wrote",
            remedy="check the name",
        ) from error


def decode(content: bytes, name: str) -> Calibration:
    """Decode a file's content; `name` is its name in messages. Raises as `load`."""
    try:
        document = parse_yaml(content, name)
        _check_version(document.tree, name)
        entries = read_model(document, CalibrationDocument)
    except (YamlInvalid, SchemaMismatch) as error:
        raise CalibrationUnreadable(
            error.subject,
            found=error.found,
            expected=error.expected,
            remedy="give the file as `drivegain fit` wrote it, or fit the logs again",
        ) from error
    edited = _edited_sections(document.tree)
    if edited:
        raise CalibrationRefused(
            name,
            found=f"a change by hand in {', '.join(edited)}",
            expected="the content that was fitted",
            remedy="a calibration is evidence: fit the logs again instead of correcting it",
        )
    return calibration_of(entries)


def _check_version(tree: object, name: str) -> None:
    # Before the schema: in a later version every key may be unknown, and only the version explains it.
    version = tree.get("version") if isinstance(tree, dict) else None
    if version != VERSION:
        raise CalibrationUnreadable(
            name,
            found="no calibration" if version is None else f"version {version}",
            expected=f"a calibration of version {VERSION}",
            remedy="give the file that `drivegain fit` wrote, or fit the logs again with this drivegain",
        )


def _edited_sections(tree: Mapping[str, Any]) -> tuple[str, ...]:
    found = _digests({key: value for key, value in tree.items() if key not in _ENVELOPE})
    noted = tree["digests"]
    return tuple(sorted(key for key in found.keys() | noted.keys() if found.get(key) != noted.get(key)))


def _digests(body: Mapping[str, object]) -> dict[str, str]:
    """Compute the SHA-256 of each section in canonical JSON, so that an edit can be located."""
    return {
        key: hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
        for key, value in body.items()
    }


def _percent(part: float, whole: float) -> float | None:
    ratio = 100.0 * part / whole if whole else math.inf
    return ratio if math.isfinite(ratio) else None


def _gain_document(gain: Gain) -> dict[str, object]:
    return {
        "axis": gain.axis,
        "value": gain.value,
        "std": gain.std,
        "std_percent": _percent(gain.std, abs(gain.value)),
        "unit": gain.unit,
        "nameplate": gain.nameplate,
        "change_percent": _percent(gain.value - gain.nameplate, gain.nameplate),
    }


def _parameter_document(parameter: Parameter) -> dict[str, object]:
    return {
        "name": parameter.name,
        "value": parameter.value,
        "std": parameter.std,
        "std_percent": _percent(parameter.std, abs(parameter.value)),
        "unit": parameter.unit,
    }


def _source_document(source: Source) -> dict[str, object]:
    document = asdict(source)
    # Lists, as YAML returns them.
    return {**document, "recording": None if source.recording is None else _listed(document["recording"])}


def _listed(document: dict[str, object]) -> dict[str, object]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in document.items()}


def _error_document(error: RelativeError | None) -> dict[str, object] | None:
    if error is None:
        return None
    # NaN marks an axis that did not move; the reader refuses any other number that is not finite.
    return {"axes": [None if math.isnan(value) else value for value in error.axes], "total": error.total}
