"""What the tests see in a page: marks, commands, and a reader who notices what differs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.pages.blocks import State, blocks_of, inline_commands, needed_packages, without_marked
from tests.pages.terminal import Reader
from tests.pipeline.transcript import commands_of

PAGE = """# A page

<!-- needs: pandas -->

```sh
drivegain scan CELL
```

<!-- not run: needs root -->
```sh
sudo ip link
```

<!-- not run: asks a person -->
```console
$ drivegain calibrate CELL
```

```console
$ true && echo "it is $(( 1 + 1 ))"
it is 2
```

<!-- saved as: torque.py -->
```python
import pinocchio
```

`drivegain plan CELL --duration 8`, and \\`drivegain is escaped\\`.
"""


def test_a_command_without_console_or_mark_is_open() -> None:
    states = [(block.state, len(block.commands)) for block in blocks_of(PAGE)]
    assert states == [
        (State.OPEN, 1),
        (State.MARKED, 1),
        (State.MARKED, 1),
        (State.RUN, 1),
        (State.RUN, 0),
    ]


def test_a_saved_block_runs_by_a_command_alone() -> None:
    saved = blocks_of(PAGE)[-1]
    assert saved.saved_as == "torque.py"
    assert not saved.runs_here


def test_marked_blocks_are_not_typed_and_lines_keep_their_numbers() -> None:
    (command,) = commands_of(without_marked(PAGE))
    assert command.text.startswith("true")
    assert PAGE.splitlines()[command.line - 1] == f"$ {command.text}"


def test_commands_in_sentences_and_needed_packages_are_found() -> None:
    assert inline_commands(PAGE) == ("drivegain plan CELL --duration 8",)
    assert needed_packages(PAGE) == ("pandas",)


@pytest.mark.parametrize(
    ("typed", "complaint"),
    [
        ("$ echo two\nthree\n", "also shows: three"),
        ("$ false\n", "exit code 1"),
        ("$ echo Traceback\n", "Traceback"),
    ],
)
def test_the_reader_notices_what_differs(
    typed: str,
    complaint: str,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = list(commands_of(f"```console\n{typed}```\n"))
    with pytest.raises(AssertionError, match=complaint):
        Reader("page", capfd).follow(commands)


def test_the_reader_takes_a_failure_that_the_page_shows(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = (
        "```console\n$ sh -c 'echo error: no; exit 3'\nerror: no\n$ sh -c 'exit 4'\n$ echo "
        "$?\n4\n```\n"
    )
    Reader("page", capfd).follow(list(commands_of(page)))
