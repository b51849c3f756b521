"""Output in any encoding: characters that the terminal's encoding lacks are printed in ASCII, never an error.

Superscripts become `^2`, Greek letters their names, accented letters their bases, by Unicode's own data; a table has
the rest. Frames of tables need none of this: rich draws them in ASCII where the encoding is not a Unicode one.
"""

from __future__ import annotations

import codecs
import sys
import unicodedata
from io import TextIOWrapper
from typing import Final

_ASCII: Final = str.maketrans(
    {
        "–": "-", "—": "-", "−": "-", "⁻": "^-", "₋": "-", "₊": "+", "±": "+-", "×": "x", "·": "*", "╲": "/",
        "√": "sqrt", "≤": "<=", "≥": ">=", "→": "->", "↔": "<->", "‖": "||", "∞": "inf", "°": " deg", "µ": "u",
        "λ": "lambda", "…": "...", "’": "'", "“": "'", "”": "'", "✓": "+", "✗": "x", "★": "*", "†": "+", "●": "*",
        **dict(zip("▁▂▃▄▅▆▇█", "_..-=+##", strict=True)),
    }
)  # fmt: skip


def in_ascii(text: str) -> str:
    """The text in ASCII."""
    return "".join(_character(character) for character in text.translate(_ASCII)).replace("^-^", "^-")


def _character(character: str) -> str:
    if character.isascii() or unicodedata.combining(character):
        return character if character.isascii() else ""
    alphabet, _, letter = unicodedata.name(character, "").partition(" LETTER ")
    if alphabet.startswith("GREEK"):
        name = letter.split(" WITH ")[0].lower()
        return name.capitalize() if "CAPITAL" in alphabet else name
    base = "".join(part for part in unicodedata.normalize("NFKD", character) if part.isascii())
    return ("^" if unicodedata.decomposition(character).startswith("<super>") else "") + (base or "?")


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return in_ascii(error.object[error.start : error.end]), error.end


def replace_what_cannot_be_printed() -> None:
    """Make stdout and stderr print such characters in ASCII, in every encoding, from now on."""
    codecs.register_error("aeroloop.ascii", _replace)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="aeroloop.ascii")
