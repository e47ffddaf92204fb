"""Symbolic and hard links to a controller's file, and which of them a write may follow."""

from __future__ import annotations

import errno
import os
import shlex
import stat
from pathlib import Path

from daq.errors import ControllerUnfit


def followed(file: Path) -> Path:
    """Resolve the symbolic links of a file's name, those of its folders included.

    A file that is gone resolves to where its links still lead.

    Args:
        file: as it was declared. A name that was resolved before has no links left to judge.

    Raises:
        ControllerUnfit: the links form a circle, one of them belongs to another user, or they lead into a folder in
            which everybody may exchange the file.
    """
    try:
        target, links = file.resolve(), _links(file)
    except RuntimeError as error:  # of Python before 3.13
        raise _circle(file) from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _circle(file) from error
        raise
    status, folder = _status(target), _status(target.parent)
    owner = None if status is None else status.st_uid
    for link in links:
        made_by = link.lstat().st_uid
        if made_by not in {0, os.geteuid(), owner}:
            named = "" if link == file else f" ({link})"
            whose = f"to {target}, which is not there" if owner is None else f"to a file of user {owner}"
            raise ControllerUnfit(
                str(file),
                found=f"a symbolic link{named} that user {made_by} has made, {whose}",
                expected="a link of the file's owner, or of you",
                remedy="name the file itself, or make the link anew",
            )
    if links and folder is not None and folder.st_mode & stat.S_IWOTH:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link into {target.parent}, a folder that everybody may write",
            expected="a folder in which nobody else can exchange the file",
            remedy="take that right away (`chmod o-w`), or name the file itself",
        )
    return target


def _links(file: Path) -> tuple[Path, ...]:
    """Symbolic links on the way to a file, the links that they lead to included."""
    found: dict[Path, None] = {}
    names = [file.absolute()]
    while names:
        name = names.pop()
        for place in (name, *name.parents):
            if place not in found and place.is_symlink():
                found[place] = None
                names.append(place.parent / place.readlink())
    return tuple(found)


def _status(file: Path) -> os.stat_result | None:
    """Status of a file, None where it is gone or may not be looked at."""
    try:
        return file.lstat()
    except OSError:
        return None


def require_there(file: Path) -> None:
    """Refuse a symbolic link that leads nowhere, by that name: "no such file" would be hard to believe.

    A file of several names (hard links) is refused too: a new file takes the place of one name, and whoever reads the
    others goes on with the old gains.

    Raises:
        ControllerUnfit: for either; and see `followed`.
    """
    target = followed(file)
    if file.is_symlink() and not target.exists():
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link to {target}, which is not there",
            expected="a link that leads to the controller's file",
            remedy="correct the link, or name the file itself",
        )
    if target.is_file() and (names := target.stat().st_nlink) > 1:
        quoted = shlex.quote(str(target))
        raise ControllerUnfit(
            str(file),
            found=f"a file with {names} names (hard links)",
            expected="one name: under the others the old gains would stay",
            remedy="find the others (`find / -xdev -samefile FILE`) and make symbolic links of them, or give this name "
            f"a file of its own: cp -p {quoted} {quoted}.new && mv {quoted}.new {quoted}",
        )


def _circle(file: Path) -> ControllerUnfit:
    return ControllerUnfit(
        str(file),
        found="symbolic links that go round in a circle",
        expected="a link that leads to the controller's file",
        remedy="correct the link, or name the file itself",
    )
