"""The console of all tables: rich's, which lays text out in the characters that the terminal's encoding has."""

from __future__ import annotations

from typing import Any

import rich.console
from rich.text import Text

from aeroloop.service.terminal.encoding import in_ascii


class Console(rich.console.Console):
    """Rich's console. Where the encoding is not a Unicode one, it lays out ASCII, so that columns stay aligned."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string, as rich's console makes it."""
        return super().render_str(in_ascii(text) if self.options.ascii_only else text, **options)
