"""The controller's file as a target: only the numbers of the gains change,
and the file is replaced whole.

The order of a write: lock, the file is still the reviewed one, backup, temporary file, read back
and compared, the file is still the same, rename. A kill at any point leaves the old file or the new
one.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import shlex
from collections.abc import Callable, Iterator, Mapping
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
from daq.formats.scalar import ControllerDocument, rewrite_gain
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
from ident.calibration import Calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class FileEdit(Edit):
    """Planned change of a controller's file."""

    file: Path  #: as it was named; `subject` is the file behind its symbolic links
    format: ControllerFormat | None = None  #: of the file; None where its name says it

    @property
    def name(self) -> str:
        """The file as it was named."""
        return str(self.file)

    @property
    def place(self) -> Path:
        """The file as it was named."""
        return self.file

    @property
    def diff(self) -> str:
        """The change as a unified diff, empty where there is none."""
        name = " ".join(self.file.name.splitlines())
        before, after = (
            self.document(content or b"").text for content in (self.before, self.after)
        )
        lines = difflib.unified_diff(
            before.splitlines(keepends=True),
            after.splitlines(keepends=True),
            f"{name} (now)",
            f"{name} (calibrated)",
            n=1,
        )
        return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)

    @property
    def comments(self) -> dict[str, str]:
        """Comment after each gain on its line, by axis; a write leaves it as it is."""
        document = self.document(self.before or b"")
        scalars = document.locate(tuple(change.key for change in self.changes))
        found = {}
        for change, scalar in zip(self.changes, scalars, strict=True):
            comment = comment_behind(document.text[scalar.end :], str(self.file), self.format)
            if comment:
                found[change.axis] = comment
        return found

    def document(self, content: bytes) -> ControllerDocument:
        """Parse a content in the file's format."""
        return decode_document(content, str(self.source or self.file), self.format)


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
        """The controller's file of a cell.

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
            raise ConfigurationInconsistent(
                f"cell {cell.name!r}: controller",
                found="none" if controller is None else "no file, or no key of each gain in it",
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
        keys = list(self.keys.values())
        doubled = sorted({key for key in keys if keys.count(key) > 1})
        if doubled:
            raise ControllerUnfit(
                "controller.gains",
                found=f"{', '.join(doubled)} for more than one axis",
                expected="a key of its own for each axis",
                remedy="correct the cell configuration",
            )
        require_existing(self.file)
        content = read_controller_file(self.file)
        now = decode_document(content, str(self.file), self.format)
        scalars = now.locate(tuple(self.keys[gain.axis] for gain in calibration.gains))
        changes = []
        for gain, scalar in zip(calibration.gains, scalars, strict=True):
            factor = self.factors.get(gain.axis, 1.0)
            if is_writable(gain):
                put = rewrite_gain(scalar, gain.value, gain.std, factor)
            else:
                put = None
            planned = None if put is None else (put.new, put.spelling)
            changes.append(
                GainChange.of(gain, scalar.key, scalar.line, scalar.value / factor, planned)
            )
        for one, other in combinations(scalars, 2):
            # An axis would get the gain of the other
            if one.start < other.end and other.start < one.end:
                raise ControllerUnfit(
                    f"{self.file}, line {one.line}",
                    found=f"{one.key} and {other.key}, which name the same number",
                    expected="a number of its own for each axis",
                    remedy="correct `controller.gains` of the cell configuration; nothing "
                    "was written",
                )
        after = now.with_values(
            {change.key: change.spelling for change in changes if change.spelling}
        )
        return FileEdit(
            subject=self.subject,
            before=content,
            after=after.content,
            changes=tuple(changes),
            unexpected=_changed_since_recording(calibration, str(self.file), sha256(content)),
            file=self.file,
            format=self.format,
        )

    def plan_rollback(self) -> FileEdit:
        """See `Target.plan_rollback`: the newest backup that differs from the file."""
        target = Path(self.subject)
        if target.exists():
            before = read_controller_file(target)
        else:
            before = None
        found = backups(target)
        # A writer that was killed before it replaced the file leaves a backup of the present
        # content.
        others = [one for one in found if before is None or one.was != short_digest(before)]
        if not others:
            what = "no backup next to it"
            if found:
                what = f"{counted(len(found), 'backup')} with the same content"
            raise CalibrationRefused(
                str(self.file),
                found=what,
                expected=f"{target.name}.<time>.<digests>.bak with another content",
                remedy="nothing was changed; drivegain has not written this file since, or its "
                "backups were moved: copy the one that you want back next to it, or over it",
            )
        backup = others[-1]
        after = backup.content()
        if before is not None and short_digest(before) != backup.after_digest:
            one = shlex.quote(str(backup.path))
            other = shlex.quote(str(self.file))
            raise ControllerChanged(
                str(self.file),
                found=f"content {short_digest(before)}…",
                expected=f"{backup.after_digest}…, as drivegain wrote it when it made "
                f"{backup.path.name}",
                remedy="the file was edited since, and a rollback would lose that; compare with "
                f"`diff {one} {other}`; to go back all the same, `cp {one} {other}`",
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
                found = None
            else:
                found = read_controller_file(target)
            if (str(target), found) != (edit.subject, edit.before):
                raise ControllerChanged(
                    str(self.file),
                    found="another file" if found is None else f"content {short_digest(found)}…",
                    expected="no file, as planned"
                    if edit.before is None
                    else f"{short_digest(edit.before)}…, as shown",
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
            numbers = {"old": change.current_gain, "new": change.new, "std": change.std}
            finite = {
                name: value if math.isfinite(value) else None for name, value in numbers.items()
            }
            changes.append({"axis": change.axis, "key": change.key, "unit": change.unit, **finite})
        return {"changes": changes}

    def write(self, edit: FileEdit, now: datetime, who: str) -> Written:
        """See `Target.write`; `who` is in the audit alone."""
        target = Path(edit.subject)
        if edit.before is None:
            try:
                replace_file(target, edit.after, check=_last_check(target, edit), like=edit.source)
            except BaseException:  # an interrupt too: the file comes back whole, or not at all
                with contextlib.suppress(OSError):
                    if _content(target) == edit.after:  # and not one that another program has made
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
                found = _content(target)
                if found == edit.before:
                    backup.unlink()
                elif found == edit.after:
                    backup.replace(target)
                    fsync_folder(target.parent)
            if isinstance(error, WriteUnconfirmed) and _content(target) == edit.before:
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


def _changed_since_recording(
    calibration: Calibration, file: str, base_sha256: str
) -> tuple[GateFinding, ...]:
    """Compare with the first log that was recorded with another content of the file."""
    for log in calibration.sources:
        if log.recording is None:
            recorded = None
        else:
            recorded = log.recording.controller_sha256
        if recorded is not None and recorded != base_sha256:
            remedy = (
                "the file was changed since, by hand or by an earlier write: review its gains and "
                "the diff of this dry run, and where both are right, repeat it with --base "
                f"{base_sha256}"
            )
            expected = f"{recorded[:12]}…, as when {log.name} was recorded"
            return ((file, f"content {base_sha256[:12]}…", expected, remedy),)
    return ()


def _last_check(target: Path, edit: FileEdit) -> Callable[[bytes], None]:
    """Make the check right before the rename; the lock excludes every drivegain, and no editor.

    Between the check and the rename are two system calls; a file that is saved in between is still
    lost.
    """

    def check(written: bytes) -> None:
        document = edit.document(written)
        if edit.before is None or edit.source is not None:
            document.locate(())
        else:
            document.check_against(
                edit.document(edit.before), {one.key: one.spelling for one in edit.changes}
            )
        found = _content(target)
        if found != edit.before:
            raise ControllerChanged(
                str(target),
                found="no file any more" if found is None else f"content {short_digest(found)}…",
                expected="no file, as before"
                if edit.before is None
                else f"{short_digest(edit.before)}…, as before this write",
                remedy="the file was saved meanwhile, and stays as it was saved: take a "
                "new dry run",
            )

    return check


def _content(target: Path) -> bytes | None:
    """Content of the file now, None where it is gone."""
    try:
        return target.read_bytes()
    except FileNotFoundError:
        return None
