"""Text of strangers on its way to a terminal or into a line of a log."""

from __future__ import annotations


def printable(text: str) -> str:
    """A text as one line that does nothing to a terminal: control characters, newlines too, become spaces.

    Whatever comes from the network or a log goes through this before a terminal or a log line has it.
    """
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() else " " for character in text)
