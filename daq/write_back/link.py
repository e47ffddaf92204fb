"""Links to a controller's file: symbolic ones are followed to where they lead, if that place is nobody else's."""

from __future__ import annotations

import errno
import os
import shlex
import stat
from pathlib import Path

from daq.errors import ControllerUnfit


def followed(file: Path) -> Path:
    """The file itself, symbolic links followed; a file that is gone is where its links still lead.

    Raises:
        ControllerUnfit: the links go round in a circle, belong to a stranger, or lead into a folder in which everybody
            may exchange the file.
    """
    try:
        target = file.resolve()
    except RuntimeError as error:  # of Python before 3.13
        raise _circle(file) from error
    try:
        owner = target.lstat().st_uid
        folder = target.parent.stat()
    except FileNotFoundError:
        return target
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _circle(file) from error
        raise
    if not file.is_symlink():
        return target
    if (made_by := file.lstat().st_uid) not in {0, os.geteuid(), owner}:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link that user {made_by} has made, to a file of user {owner}",
            expected="a link of whoever owns the file, or of you",
            remedy="name the file itself, or make the link anew",
        )
    if folder.st_mode & stat.S_IWOTH:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link into {target.parent}, a folder that everybody may write",
            expected="a folder in which nobody else can exchange the file",
            remedy="take that right away (`chmod o-w`), or name the file itself",
        )
    return target


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
