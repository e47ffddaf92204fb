"""Who runs this program, as the operating system knows them."""

from __future__ import annotations

import os
import pwd


def login() -> str:
    """Name of the user whose process this is, or the number of one without a name.

    Not what LOGNAME or USER say, which `getpass.getuser` asks first: a name that anybody may choose makes no second
    person.
    """
    number = os.getuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"uid {number}"
