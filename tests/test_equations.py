"""Equations (C.1)–(C.81) of the paper: each is in the code under its number."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_every_equation_is_in_the_code() -> None:
    packages = ("protocol", "plant_emulator", "service")
    code = "".join(path.read_text() for package in packages for path in (ROOT / package).rglob("*.py"))
    # "(C.16)–(C.49)" names a range and vouches for nothing between its ends: the ends of ranges do not count either.
    alone = re.sub(r"\(C\.\d+\)–\(C\.\d+\)", "", code)
    written = {int(number) for number in re.findall(r"\(C\.(\d+)\)", alone)}
    assert written == set(range(1, 82)) - {74}  # a step of the proof of (C.77)
