"""The reader of console blocks, without which a page could promise anything."""

from __future__ import annotations

from tests.pipeline.transcript import Command, commands_of, shows

PAGE = """\
# A page
```console
$ drivegain scan cell.yaml
node 1 …
$ cat > x <<'END'
> a: 1
> END
$ echo $?
0
```
```sh
$ not this
```
```console second terminal
$ drivegain simulate demo
6 amplifiers
```
"""


def test_commands_keep_their_order_with_what_follows_them() -> None:
    assert commands_of(PAGE) == (
        Command(3, "drivegain scan cell.yaml", "node 1 …", False),
        Command(5, "cat > x <<'END'\na: 1\nEND", "", False),
        Command(8, "echo $?", "0", False),
        Command(15, "drivegain simulate demo", "6 amplifiers", True),
    )


def test_what_is_not_seen_is_reported_and_order_counts() -> None:
    assert shows("gain … 33.9\n… written", "gain   J1  33.9\nall was written") is None
    assert shows("gain … 34.9", "gain J1 33.9") == "gain … 34.9"
    assert shows("b\na", "a b") == "a"
    assert shows("", "anything") is None
