"""Keys of a live view, on a pseudo-terminal."""

from __future__ import annotations

import os
import termios
from collections.abc import Iterator

import pytest

from aeroloop.service.terminal.keyboard import keyboard

FOREVER_S = 60.0
"""For what is there already."""


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """The user's end of a terminal, and the program's, which is stdin."""
    user, program = os.openpty()
    with os.fdopen(program, "r") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield user, program
    os.close(user)


def test_keys_are_read_without_enter_and_escape_sequences_are_left_out(terminal: tuple[int, int]) -> None:
    with keyboard() as read:
        assert read is not None
        assert read(0.0) == ""
        os.write(terminal[0], b"sy")
        assert read(FOREVER_S) == "sy"
        os.write(terminal[0], b"\x1b[A")
        assert read(FOREVER_S) == ""


def test_the_terminal_is_restored_also_after_an_error(terminal: tuple[int, int]) -> None:
    before = termios.tcgetattr(terminal[1])
    with pytest.raises(KeyboardInterrupt), keyboard():  # noqa: PT012  # what is raised comes from the block
        assert not termios.tcgetattr(terminal[1])[3] & (termios.ECHO | termios.ICANON)
        raise KeyboardInterrupt
    assert termios.tcgetattr(terminal[1]) == before


def test_there_are_no_keys_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        with keyboard() as read:
            assert read is None
