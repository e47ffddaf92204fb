"""Counting what a person reads: README's section, and a screen that is drawn again."""

from __future__ import annotations

from tests.studies.first_certificate import README, answer_to, screen_of, try_it, words_of


def test_the_section_of_readme_has_the_three_commands_of_a_first_session() -> None:
    section = try_it(README.read_text(encoding="utf-8"))
    verbs = [command.split()[1] for command in section.commands]
    assert verbs == ["simulate", "init", "calibrate"]
    assert "What it does" not in section.text


def test_a_progress_line_that_is_drawn_again_counts_once() -> None:
    bars = "".join(f"\rrecording ━━ {done}/9 moves" for done in range(10))
    up = "\x1b[1A\x1b[2K"
    output = f"\x1b[1mNew session\x1b[0m\r\n{bars}\r\n{up}recording ━━━ 9/9 moves\r\nDone\r\n"
    assert screen_of(output).split("\n")[:3] == ["New session", "recording ━━ 9/9 moves", "Done"]
    assert words_of(screen_of(output)) == 6


def test_signs_are_no_words() -> None:
    assert words_of("── block-1: DISC (4.59 kg) ──") == 4


def test_each_question_of_a_session_has_its_answer() -> None:
    assert answer_to("Mass of disc read from the scale [kg]") == "4.59"
    assert answer_to("Type yes to write to press-4.yaml, else Enter") == "yes"
