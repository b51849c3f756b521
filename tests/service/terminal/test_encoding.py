"""Output in encodings that lack characters in use."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import aeroloop.service
from aeroloop.service.terminal.console import Console
from aeroloop.service.terminal.encoding import in_ascii, replace_what_cannot_be_printed

SOURCES = Path(aeroloop.service.__file__).parent


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "koi8-r", "utf-8"])
def test_any_text_is_printed_in_any_encoding(encoding: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("stdout", "stderr"):
            patch.setattr(sys, name, TextIOWrapper(BytesIO(), encoding=encoding))
        replace_what_cannot_be_printed()

        @given(st.text(st.characters(exclude_categories=[])))  # surrogates included: names of files have them
        def check(text: str) -> None:
            for stream in (sys.stdout, sys.stderr):
                stream.write(text)
                stream.flush()

        check()


@given(st.text(st.characters(exclude_categories=[])))
def test_text_in_ascii_breaks_no_json(text: str) -> None:
    assert in_ascii(text).isascii()
    json.loads(in_ascii(json.dumps({"text": text}, ensure_ascii=False)))


def test_every_character_that_the_package_prints_has_words_of_its_own() -> None:
    """A `?` says nothing; only frames of tables, which rich replaces, may be one."""
    printed = {c for path in SOURCES.glob("cli/*.py") for c in path.read_text(encoding="utf-8") if not c.isascii()}
    printed |= set("×·°µ²³⁻⁴–—…‖₀₁→≤≥±−✓✗★†βγδεζηθλνστφψωΓΦ▁▂▃▄▅▆▇█╲’")
    assert not [c for c in printed if "?" in in_ascii(c) or not in_ascii(c)]
    assert in_ascii("6.25 ×10⁻⁴, 8176 V²·s, 23.01°, ‖z‖, δ_V1, 40 µs") == (
        "6.25 x10^-4, 8176 V^2*s, 23.01 deg, ||z||, delta_V1, 40 us"
    )


def test_columns_stay_aligned_in_ascii() -> None:
    from rich.table import Table

    printed = BytesIO()
    page = TextIOWrapper(printed, encoding="ascii")
    table = Table("", "unit", box=None)
    table.add_row("ε", "right")
    table.add_row("voltage", "left")
    Console(file=page, width=40).print(table)
    page.flush()
    lines = printed.getvalue().decode().splitlines()
    assert lines[1].index("right") == lines[2].index("left")


@pytest.mark.processes
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_command_prints_tables_where_the_terminal_is_not_unicode(encoding: str) -> None:
    """One process; only the interpreter's start sets the encoding. No time is asserted."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "aeroloop", "show", "spec"],
        env={**os.environ, "PYTHONIOENCODING": encoding},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert "omega rate" in done.stdout.decode(encoding)
