"""`calibration.yaml`, the result of a fit:
written whole, read strictly, and every edit by hand is detected.

The file adds percentages for people and writes NaN as null. Sections without such a difference
(`Source`, `Recording`, `Diagnosis`, `CalibratedRobot`, `PayloadMass`, `EncoderMisfit`, `FullSet`)
are read as the classes of `ident`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import yaml
from pydantic import AfterValidator, Field, model_validator

from daq.arguments import A_FILE_TO_WRITE, A_LIST, A_PATH, checks_arguments, of_kind
from daq.config.cell_schema import CUTOFF_HZ
from daq.config.yaml_file import (
    IN_ORDER,
    DocumentKind,
    StrictModel,
    kind_of_head,
    kind_of_tree,
    parse_yaml,
    read_file,
    read_model,
)
from daq.errors import (
    CalibrationMissing,
    CalibrationRefused,
    CalibrationUnreadable,
    SchemaMismatch,
    YamlInvalid,
)
from daq.files import replace_file, sha256
from ident.calibration import (
    AcceptedEffect,
    CalibratedRobot,
    Calibration,
    EncoderMisfit,
    Gain,
    Parameter,
    PayloadMass,
    Source,
)
from ident.data.conditioning import FILTER_ORDER
from ident.errors import Diagnosis
from ident.estimators.estimate import RelativeError
from ident.physical.full_set import FullSet

if TYPE_CHECKING:  # reading a calibration needs no effects
    from ident.effects.effect import Effect

_LARGEST = 1e30  #: Size of a number, in any unit: products of three of them are still finite
_Number = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
_Positive = Annotated[float, Field(ge=0.0, le=_LARGEST)]
_FILTER_BOUNDS = {
    **dict.fromkeys(("position_cutoff_hz", "decimation_cutoff_hz"), CUTOFF_HZ),
    "position_order": FILTER_ORDER,
    "current_cutoff_hz": CUTOFF_HZ,
    "current_order": (0, FILTER_ORDER[1]),
    "standstill_rad_s": (0.0, 1e6),
    "standstill_share": (1e-6, 1.0),
}


def _check_filter(
    found: dict[str, int | float | list[float]],
) -> dict[str, int | float | list[float]]:
    """Check the settings that a filter is made of:
    one of order 10⁹, or of 10⁻³⁰⁰ Hz, takes all memory.
    """
    for name, (least, most) in _FILTER_BOUNDS.items():
        values = found.get(name, [])
        if not all(
            least <= value <= most for value in (values if isinstance(values, list) else [values])
        ):
            raise ValueError(f"{name} from {least:g} to {most:g}")
    return found


class GainEntry(StrictModel):
    """One drive gain with its nameplate; the percentages are for people,
    `change_percent` from the nameplate.
    """

    axis: str
    value: _Number
    std: _Positive
    std_percent: float | None
    unit: str
    nameplate: _Number
    change_percent: float | None


class ParameterEntry(StrictModel):
    """One dynamic parameter or coefficient of an effect."""

    name: str
    value: _Number
    std: _Positive
    std_percent: float | None
    unit: str


class RelativeErrorEntry(StrictModel):
    """Relative errors in percent; null for an axis that did not move."""

    axes: tuple[_Positive | None, ...]
    total: _Positive


class EffectEntry(StrictModel):
    """One accepted effect."""

    name: str
    axis: str
    settings: dict[str, _Number]
    coefficients: tuple[ParameterEntry, ...]
    error_before_percent: _Positive
    error_after_percent: _Positive
    ambiguity: tuple[str, ...]
    largest_torque: tuple[_Positive, ...] | None = None  # files of earlier versions lack it
    described: tuple[_Number, ...] | None = None  # likewise
    package: str | None = None  # likewise


class CalibrationBody(StrictModel):
    """Schema of a calibration, without the envelope of a file;
    its keys are in the order of `Calibration`.
    """

    cell: str
    method: str
    gains: tuple[GainEntry, ...]
    parameters: tuple[ParameterEntry, ...]
    effects: tuple[EffectEntry, ...]
    relative_error_percent: RelativeErrorEntry
    holdout_error_percent: RelativeErrorEntry | None
    condition: _Positive
    rows: Annotated[int, Field(ge=0, le=10**15)]
    filter: Annotated[dict[str, int | float | list[float]], AfterValidator(_check_filter)]
    sources: tuple[Source, ...]
    configuration_sha256: str
    created: str
    software: str
    # Files of earlier versions lack the following.
    session_began_s: float | None = None
    nameplate_holdout_error_percent: RelativeErrorEntry | None = None
    recording_configuration_sha256: str | None = None
    covariance_factor: tuple[tuple[_Number, ...], ...] | None = None
    diagnoses: tuple[Diagnosis, ...] = ()
    current_residual: tuple[_Positive, ...] | None = None
    passive_joints: tuple[str, ...] = ()
    payload_mass: tuple[PayloadMass, ...] = ()
    encoder_misfit: EncoderMisfit | None = None
    full_parameters: FullSet | None = None
    robot: CalibratedRobot | None = None

    @model_validator(mode="after")
    def _check_payload_mass(self) -> Self:
        axes = [gain.axis for gain in self.gains]
        for one in self.payload_mass:
            if one.mass_kg <= 0.0 or one.tolerance_kg < 0.0:
                raise ValueError(f"payload_mass of {one.payload} above 0, and no tolerance below 0")
            if [influence.axis for influence in one.gains] != axes:
                raise ValueError(
                    f"payload_mass of {one.payload} with an entry for each of the axes "
                    f"{', '.join(axes)}"
                )
            if one.parameters_per_kg and len(one.parameters_per_kg) != len(self.parameters):
                raise ValueError(
                    f"payload_mass of {one.payload} with parameters_per_kg for each of the "
                    f"{len(self.parameters)} parameters"
                )
        return self


class CalibrationDocument(CalibrationBody):
    """Schema of the whole file; the reader compares the `digests`."""

    document_kind: ClassVar[DocumentKind | None] = DocumentKind.CALIBRATION

    format: Literal["drivegain-calibration"]
    version: int
    digests: dict[str, str]


_CLASSES: dict[type, type] = {
    CalibrationDocument: Calibration,
    GainEntry: Gain,
    ParameterEntry: Parameter,
    EffectEntry: AcceptedEffect,
}


def _from_entry(entry: object) -> Any:
    """Convert a checked entry, with all entries in it,
    to the class of `ident` whose fields it has.
    """
    if isinstance(entry, tuple):
        return tuple(map(_from_entry, entry))
    if isinstance(entry, RelativeErrorEntry):
        return RelativeError(
            tuple(math.nan if value is None else value for value in entry.axes), entry.total
        )
    made = _CLASSES.get(type(entry))
    if made is None:
        return entry
    names = [field.name for field in fields(made) if field.name not in _OF_THE_PROCESS]
    return made(**{name: _from_entry(getattr(entry, name)) for name in names})


VERSION = 1
#: Fields of a calibration that are code, and in no file
_OF_THE_PROCESS = frozenset({"own_effects"})
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


class _QuickDumper(yaml.CSafeDumper):
    """The same by libyaml, four times as fast, and the same bytes where no text is `_UNUSUAL`."""

    ignore_aliases = _Dumper.ignore_aliases


#: In JSON: escaped characters, an empty key, rare scripts
_UNUSUAL = re.compile(r'\\|"":|[\U00010000-\U0010ffff]')
_NUMBER = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$")


def _represent_text(dumper: _Dumper | _QuickDumper, text: str) -> yaml.ScalarNode:
    # Line breaks of Unicode (U+0085, U+2028) survive in double quotes only.
    return dumper.represent_scalar(
        "tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"'
    )


for _kind in (_Dumper, _QuickDumper):
    _kind.add_representer(str, _represent_text)
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+0123456789."))


def as_document(calibration: Calibration) -> dict[str, Any]:
    """Return the calibration as lists, mappings and numbers:
    the object of `fit --json` and the body of the file.

    Percentages of zero are None.
    """
    names = [field.name for field in fields(calibration) if field.name not in _OF_THE_PROCESS]
    return {name: _as_entry(getattr(calibration, name)) for name in names}


def _as_entry(value: Any) -> Any:
    match value:
        case list() | tuple():
            return [_as_entry(item) for item in value]
        case dict():
            return {key: _as_entry(item) for key, item in value.items()}
        case RelativeError():
            # NaN marks an axis that did not move; the reader refuses any other number that is not
            # finite.
            return {
                "axes": [None if math.isnan(axis) else axis for axis in value.axes],
                "total": value.total,
            }
        case Gain():
            change_percent = _percent(value.value - value.nameplate, value.nameplate)
            std_percent = _percent(value.std, abs(value.value))
            entry = GainEntry.model_construct(
                **asdict(value), std_percent=std_percent, change_percent=change_percent
            )
            return entry.model_dump()
        case Parameter():
            std_percent = _percent(value.std, abs(value.value))
            return ParameterEntry.model_construct(
                **asdict(value), std_percent=std_percent
            ).model_dump()
    return (
        {f.name: _as_entry(getattr(value, f.name)) for f in fields(value)}
        if is_dataclass(value)
        else value
    )


@checks_arguments(calibration=of_kind(Calibration), path=A_FILE_TO_WRITE)
def save_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write `calibration` to `path` atomically, and read it back before it replaces an older file.

    Raises:
        UsageError: an argument is of another type, or the path is that of a folder.
        CalibrationUnreadable: a number is not finite; nothing is written.
        OSError: from the file system; an old file stays as it was.
    """

    def check(content: bytes) -> None:
        # Compared as documents: NaN, for an axis that did not move, is not equal to itself.
        if as_document(decode_calibration(content, str(path))) != as_document(calibration):
            raise CalibrationUnreadable(
                str(path),
                found="another content on reading back",
                expected="what was written",
                remedy="check the disk; the file was not replaced",
            )

    replace_file(Path(path), encode_calibration(calibration), check=check)


def encode_calibration(calibration: Calibration) -> bytes:
    """Return the content of the file."""
    body = as_document(calibration)
    document = {
        "format": "drivegain-calibration",
        "version": VERSION,
        **body,
        "digests": _digests(body),
    }
    kind = _Dumper if _UNUSUAL.search(json.dumps(body, ensure_ascii=False)) else _QuickDumper
    # One entry a line: leaf collections in flow style, lines never folded.
    text = yaml.dump(
        document,
        Dumper=kind,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=2**30,
    )
    return (_HEADER + text).encode()


@checks_arguments(path=A_PATH, own_effects=A_LIST)
def load_calibration(path: Path | str, own_effects: Sequence[Effect] = ()) -> Calibration:
    """Read a calibration.

    Args:
        path: of the file.
        own_effects: effects of one's own that it may have and no installed package has; one of each
            name is enough.

    Raises:
        UsageError: an argument is of another type.
        CalibrationMissing: the file does not exist, is a folder or a pipe, or cannot be read.
        CalibrationUnreadable: not a calibration of this version, or with a wrong key, type or
            number, with its line.
        CalibrationRefused: the content was edited, with the names of the edited sections.
        EffectRefused: one of `own_effects` is no effect that can be used.
    """
    if own_effects != ():
        from ident.effects.own import families_of  # noqa: PLC0415 - reading a calibration needs no effects

        families_of(own_effects, "`own_effects`")
    calibration = decode_calibration(read_calibration_bytes(Path(path)), str(path))
    return replace(calibration, own_effects=tuple(own_effects))


def read_calibration_bytes(path: Path) -> bytes:
    """Read the content of a calibration's file, for callers that also need its digest.

    Raises:
        CalibrationMissing: see `load_calibration`.
    """
    wanted = "the file that `drivegain fit` wrote"
    return read_file(path, CalibrationMissing, expected=wanted, remedy="check the name")


def decode_calibration(content: bytes, name: str) -> Calibration:
    """Decode a file's content; `name` is its name in messages. Raises as `load_calibration`."""
    _require_calibration(name, kind_of_head(content))
    try:
        document = parse_yaml(content, name)
        # Before the schema: in a later version every key may be unknown, and only the version
        # explains it.
        version = document.tree.get("version") if isinstance(document.tree, dict) else None
        _require_calibration(name, kind_of_tree(document.tree))
        if version != VERSION:
            raise CalibrationUnreadable(
                name,
                found="no calibration" if version is None else f"version {version}",
                expected=f"a calibration of version {VERSION}",
                remedy="give the file that `drivegain fit` wrote, or fit the logs again with this "
                "drivegain",
            )
        entries = read_model(document, CalibrationDocument)
    except (YamlInvalid, SchemaMismatch) as error:
        raise CalibrationUnreadable(
            error.subject,
            found=error.found,
            expected=error.expected,
            remedy="give the file as `drivegain fit` wrote it, or fit the logs again",
        ) from error
    found = _digests({key: value for key, value in document.tree.items() if key not in _ENVELOPE})
    edited = sorted(
        key
        for key in found.keys() | entries.digests.keys()
        if found.get(key) != entries.digests.get(key)
    )
    if edited:
        raise CalibrationRefused(
            name,
            found=f"a change by hand in {', '.join(edited)}",
            expected="the content that was fitted",
            remedy="a calibration is evidence: fit the logs again instead of correcting it",
        )
    calibration: Calibration = _from_entry(entries)
    return calibration


def _require_calibration(name: str, kind: DocumentKind | None) -> None:
    """Refuse a file of another known kind.

    Raises:
        CalibrationUnreadable: it is one.
    """
    if kind not in (None, DocumentKind.CALIBRATION):
        expected = f"a calibration of version {VERSION}"
        raise CalibrationUnreadable(name, found=kind.value, expected=expected, remedy=IN_ORDER)


def _digests(body: Mapping[str, object]) -> dict[str, str]:
    """Compute the SHA-256 of each section in canonical JSON, so that an edit can be located."""
    return {
        key: sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode())
        for key, value in body.items()
    }


def _percent(part: float, whole: float) -> float | None:
    ratio = 100.0 * part / whole if whole else math.inf
    return ratio if math.isfinite(ratio) else None
