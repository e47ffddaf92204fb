"""The controller's file as a target: only the numbers of the gains change,
and the file is replaced in one step.

The order of a write:

1. take the lock;
2. compare the file with the reviewed content;
3. make a backup;
4. write a temporary file, read it back, and compare it with the planned content;
5. compare the file again;
6. rename the temporary file.

A kill at any point leaves the old file or the new one.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import combinations
from pathlib import Path

from daq.arguments import (
    A_NUMBER,
    A_PATH,
    A_PATH_OBJECT,
    A_TEXT,
    by_name,
    checks_arguments,
    of_kind,
    optional,
    require_fields,
)
from daq.config.cell import Cell
from daq.config.controller import ControllerFormat
from daq.errors import (
    CalibrationRefused,
    ConfigurationInconsistent,
    ControllerChanged,
    ControllerUnfit,
    WriteUnconfirmed,
    counted,
)
from daq.files import fsync_folder, replace_file, sha256
from daq.formats.document import comment_behind, decode_document, read_controller_file
from daq.formats.scalar import ControllerDocument, Scalar, rewrite_gain
from daq.writeback.file_access import (
    back_up,
    backups,
    exclusive_writer,
    require_existing,
    resolve_links,
)
from daq.writeback.request import (
    Edit,
    GainChange,
    GateFinding,
    is_writable,
    require_axes,
    short_digest,
)
from daq.writeback.target import Written
from ident.calibration import Calibration, Gain


@dataclass(frozen=True, slots=True, kw_only=True)
class FileEdit(Edit):
    """Planned change of a controller's file."""

    file: Path  #: as it was named; `subject` is the file behind its symbolic links
    format: ControllerFormat | None = None  #: of the file; None where its name says it

    @property
    def name(self) -> str:
        """Name of the file, as the cell or the caller has it."""
        return str(self.file)

    @property
    def place(self) -> Path:
        """The file, as the cell or the caller names it."""
        return self.file

    @property
    def diff(self) -> str:
        """The change as a unified diff, empty where there is none."""
        # A name may have line ends; in the header of a diff it is one line.
        name = " ".join(self.file.name.splitlines())
        before = self.document(self.before or b"").text
        after = self.document(self.after).text
        lines = difflib.unified_diff(
            before.splitlines(keepends=True),
            after.splitlines(keepends=True),
            f"{name} (now)",
            f"{name} (calibrated)",
            n=1,
        )
        text = ""
        for line in lines:
            text += line
            # The last line of a file may have no line end.
            if not line.endswith("\n"):
                text += "\n"
        return text

    @property
    def comments(self) -> dict[str, str]:
        """Comment after each gain on its line, by axis; a write leaves it as it is."""
        document = self.document(self.before or b"")
        keys = tuple(change.key for change in self.changes)
        scalars = document.locate(keys)
        comments = {}
        for change, scalar in zip(self.changes, scalars, strict=True):
            text_after_gain = document.text[scalar.end :]
            comment = comment_behind(text_after_gain, str(self.file), self.format)
            if comment:
                comments[change.axis] = comment
        return comments

    def document(self, content: bytes) -> ControllerDocument:
        """Parse a content in the file's format."""
        name = str(self.source or self.file)
        return decode_document(content, name, self.format)


@dataclass(frozen=True, slots=True)
class FileTarget:
    """A controller's file."""

    file: Path  #: as it was named; a symbolic link stays one, and the file behind it is replaced
    #: Key of each axis's gain, by the axis's name; not needed for a rollback
    keys: Mapping[str, str] = field(default_factory=dict)
    format: ControllerFormat | None = None  #: of the file; None where its name says it
    #: Number in the file = gain × factor, by the axis's name; 1 where it is missing
    factors: Mapping[str, float] = field(default_factory=dict)
    cell: Cell | None = None  #: that the controller drives; None where nothing is compared with it

    @classmethod
    @checks_arguments(cell=of_kind(Cell), file=optional(A_PATH))
    def of(cls, cell: Cell, file: Path | None = None) -> FileTarget:
        """Return the controller's file of a cell.

        Args:
            cell: as it is now.
            file: another file than the one that the cell names.

        Raises:
            UsageError: an argument is of another type.
            ConfigurationInconsistent: the cell names no controller file, or no keys in it.
        """
        controller = cell.controller
        chosen = cell.controller_path
        if file is not None:
            chosen = Path(file)
        if controller is None or not controller.gains or chosen is None:
            found = "no file, or no key of each gain in it"
            if controller is None:
                found = "none"
            raise ConfigurationInconsistent(
                f"cell {cell.name!r}: controller",
                found=found,
                expected="the controller's file and the key of each gain",
                remedy="add `controller: {file: ..., gains: [...]}` to the cell file",
            )
        keys = dict(zip(cell.axis_names, controller.keys, strict=True))
        factors = dict(zip(cell.axis_names, controller.factors, strict=True))
        return cls(chosen, keys, controller.format, factors, cell)

    @property
    def subject(self) -> str:
        """The file behind all symbolic links.

        Raises:
            ControllerUnfit: a link that must not be followed.
        """
        return str(resolve_links(self.file))

    def check_fields(self) -> None:
        """See `Target.check_fields`."""
        call = "write FileTarget.of(cell), or FileTarget(file, keys)"
        require_fields("the FileTarget", self, _FILE_TARGET_FIELDS, call)

    def plan(self, calibration: Calibration) -> FileEdit:
        """See `Target.plan`."""
        require_axes(calibration, self.keys)
        axes = tuple(gain.axis for gain in calibration.gains)
        document, scalars = self._located(axes)
        content = document.content
        changes = []
        for gain, scalar in zip(calibration.gains, scalars, strict=True):
            changes.append(self._change_of(gain, scalar))
        new_numbers = {}
        for change in changes:
            if change.spelling:
                new_numbers[change.key] = change.spelling
        after = document.with_values(new_numbers)
        unexpected = _changed_since_recording(calibration, str(self.file), sha256(content))
        return FileEdit(
            subject=self.subject,
            before=content,
            after=after.content,
            changes=tuple(changes),
            unexpected=unexpected,
            file=self.file,
            format=self.format,
        )

    def require_gains(self) -> None:
        """Refuse a file that cannot be read, or that lacks the gain of an axis; nothing is written.

        Raises:
            ControllerUnfit: it is such a file.
        """
        self._located(tuple(self.keys))

    def _located(self, axes: tuple[str, ...]) -> tuple[ControllerDocument, tuple[Scalar, ...]]:
        """Read the file, and find the numbers of the gains of some axes.

        Raises:
            ControllerUnfit: the file cannot be read, a gain is not there, or two axes have one.
        """
        self._require_distinct_keys()
        require_existing(self.file)
        content = read_controller_file(self.file)
        document = decode_document(content, str(self.file), self.format)
        keys = tuple(self.keys[axis] for axis in axes)
        scalars = tuple(document.locate(keys))
        self._require_distinct_numbers(scalars)
        return document, scalars

    def _require_distinct_keys(self) -> None:
        """Refuse a key of the file that two axes have.

        Raises:
            ControllerUnfit: there is one.
        """
        keys = list(self.keys.values())
        doubled = {key for key in keys if keys.count(key) > 1}
        if doubled:
            listed = ", ".join(sorted(doubled))
            raise ControllerUnfit(
                "controller.gains",
                found=f"{listed} for more than one axis",
                expected="a key of its own for each axis",
                remedy="correct the cell configuration",
            )

    def _change_of(self, gain: Gain, scalar: Scalar) -> GainChange:
        """Return the change of one gain; `scalar` is its number in the file."""
        factor = self.factors.get(gain.axis, 1.0)
        planned = None
        if is_writable(gain):
            rewritten = rewrite_gain(scalar, gain.value, gain.std, factor)
            planned = (rewritten.new, rewritten.spelling)
        current_gain = scalar.value / factor
        return GainChange.of(gain, scalar.key, scalar.line, current_gain, planned)

    def _require_distinct_numbers(self, scalars: Sequence[Scalar]) -> None:
        """Refuse two keys of the same number: an axis would get the gain of the other one.

        Raises:
            ControllerUnfit: there are such keys.
        """
        for one, other in combinations(scalars, 2):
            if one.start < other.end and other.start < one.end:
                raise ControllerUnfit(
                    f"{self.file}, line {one.line}",
                    found=f"{one.key} and {other.key}, which name the same number",
                    expected="a number of its own for each axis",
                    remedy="correct `controller.gains` of the cell configuration; nothing "
                    "was written",
                )

    def plan_rollback(self) -> FileEdit:
        """See `Target.plan_rollback`: the newest backup that differs from the file."""
        target = Path(self.subject)
        if target.exists():
            before = read_controller_file(target)
            digest = short_digest(before)
        else:
            before = None
            digest = None
        all_backups = backups(target)
        # A writer that was killed before it replaced the file leaves a backup of the present
        # content.
        others = [backup for backup in all_backups if backup.before_digest != digest]
        if not others:
            found = "no backup next to it"
            if all_backups:
                found = f"{counted(len(all_backups), 'backup')} with the same content"
            raise CalibrationRefused(
                str(self.file),
                found=found,
                expected=f"{target.name}.<time>.<digests>.bak with another content",
                remedy="nothing was changed; drivegain has not written this file since, or its "
                "backups were moved: copy the one that you want back next to it, or over it",
            )
        backup = others[-1]
        after = backup.content()
        if digest not in {None, backup.after_digest}:
            quoted_backup = shlex.quote(str(backup.path))
            quoted_file = shlex.quote(str(self.file))
            raise ControllerChanged(
                str(self.file),
                found=f"content {digest}…",
                expected=f"{backup.after_digest}…, as drivegain wrote it when it made "
                f"{backup.path.name}",
                remedy="the file was edited since, and a rollback would lose that; compare with "
                f"`diff {quoted_backup} {quoted_file}`; to go back all the same, "
                f"`cp {quoted_backup} {quoted_file}`",
            )
        return FileEdit(
            subject=str(target),
            before=before,
            after=after,
            source=backup.path,
            file=self.file,
            format=self.format,
        )

    @contextlib.contextmanager
    def lock(self, edit: FileEdit) -> Iterator[None]:
        """See `Target.lock`."""
        target = resolve_links(self.file)
        with exclusive_writer(target):
            if edit.before is None and not target.exists():
                content = None
            else:
                content = read_controller_file(target)
            if str(target) != edit.subject:
                raise ControllerChanged(
                    str(self.file),
                    found=f"a link that leads to {target}",
                    expected=f"{edit.subject}, as shown",
                    remedy="the link has changed in between: take a new dry run",
                )
            if content != edit.before:
                if content is None:
                    found = "another file"
                else:
                    found = f"content {short_digest(content)}…"
                if edit.before is None:
                    expected = "no file, as planned"
                else:
                    expected = f"{short_digest(edit.before)}…, as shown"
                raise ControllerChanged(
                    str(self.file),
                    found=found,
                    expected=expected,
                    remedy="the file has changed in between: take a new dry run",
                )
            yield

    def details(self, edit: FileEdit) -> Mapping[str, object]:
        """See `Target.details`."""
        if edit.source is not None:
            return {"restored": edit.source.name}
        changes = []
        for change in edit.changes:
            # "old" is the key of the current gain in every audit log.
            entry = {
                "axis": change.axis,
                "key": change.key,
                "unit": change.unit,
                "old": _finite_or_none(change.current_gain),
                "new": _finite_or_none(change.new),
                "std": _finite_or_none(change.std),
            }
            changes.append(entry)
        return {"changes": changes}

    def write(self, edit: FileEdit, now: datetime, who: str) -> Written:
        """See `Target.write`; `who` is in the audit alone."""
        target = Path(edit.subject)
        if edit.before is None:
            try:
                replace_file(target, edit.after, check=_last_check(target, edit), like=edit.source)
            except BaseException:
                # An interrupt, too: a rollback that failed leaves no file, as before. A file that
                # another program has made meanwhile stays.
                with contextlib.suppress(OSError):
                    if _read_content(target) == edit.after:
                        target.unlink()
                raise
            return Written(edit, None)
        backup = back_up(target, edit.before, edit.after, now)
        try:
            replace_file(target, edit.after, check=_last_check(target, edit))
        except ControllerChanged:
            backup.unlink()
            raise
        except BaseException as error:
            # Before the rename the old file is in place; after it (the folder's fsync failed) the
            # backup replaces it. A file that was saved by another program in between stays, and so
            # does the backup. A file system that allows none of this leaves both.
            with contextlib.suppress(OSError):
                content = _read_content(target)
                if content == edit.before:
                    backup.unlink()
                elif content == edit.after:
                    backup.replace(target)
                    fsync_folder(target.parent)
            is_old_in_place = False
            with contextlib.suppress(OSError):
                is_old_in_place = _read_content(target) == edit.before
            if is_old_in_place and isinstance(error, WriteUnconfirmed):
                # The old file is in place again: the write has failed, and that is certain.
                raise OSError(error.errno, error.strerror, str(target)) from error
            raise
        return Written(edit, backup)


_FILE_TARGET_FIELDS = {
    "file": A_PATH_OBJECT,
    "keys": by_name(A_TEXT),
    "format": optional(of_kind(ControllerFormat)),
    "factors": by_name(A_NUMBER),
    "cell": optional(of_kind(Cell)),
}


def _finite_or_none(number: float) -> float | None:
    """Return a number that JSON has, None for NaN and infinity."""
    if math.isfinite(number):
        return number
    return None


def _changed_since_recording(
    calibration: Calibration, file: str, base_sha256: str
) -> tuple[GateFinding, ...]:
    """Return a finding for the first log that was recorded with another content of the file;
    none where all logs have the present one.
    """
    for log in calibration.sources:
        if log.recording is None:
            continue
        recorded_sha256 = log.recording.controller_sha256
        if recorded_sha256 is None or recorded_sha256 == base_sha256:
            continue
        found = f"content {base_sha256[:12]}…"
        expected = f"{recorded_sha256[:12]}…, as when {log.name} was recorded"
        remedy = (
            "the file was changed since, by hand or by an earlier write: review its gains and "
            "the diff of this dry run, and where both are right, repeat it with --base "
            f"{base_sha256}"
        )
        return ((file, found, expected, remedy),)
    return ()


def _last_check(target: Path, edit: FileEdit) -> Callable[[bytes], None]:
    """Return the check of the temporary file and of the target, right before the rename.

    It is needed because the lock excludes other processes of drivegain, but no editor. Between the
    check and the rename are two system calls; a file that is saved in between is still lost.
    """

    def check(written: bytes) -> None:
        document = edit.document(written)
        if edit.before is None or edit.source is not None:
            # A rollback restores a backup as it is; it only has to be readable.
            document.locate(())
        else:
            document_before = edit.document(edit.before)
            new_numbers = {change.key: change.spelling for change in edit.changes}
            document.check_against(document_before, new_numbers)
        content = _read_content(target)
        if content != edit.before:
            if content is None:
                found = "no file any more"
            else:
                found = f"content {short_digest(content)}…"
            if edit.before is None:
                expected = "no file, as before"
            else:
                expected = f"{short_digest(edit.before)}…, as before this write"
            raise ControllerChanged(
                str(target),
                found=found,
                expected=expected,
                remedy="the file was saved meanwhile, and stays as it was saved: take a "
                "new dry run",
            )

    return check


def _read_content(target: Path) -> bytes | None:
    """Return the content of the file now, None where it is gone."""
    try:
        return target.read_bytes()
    except FileNotFoundError:
        return None
