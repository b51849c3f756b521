"""Equations (C.1)–(C.81) of the paper: each is in the code under its number, or left out for a reason given here."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parent.parent

LEFT_OUT = {
    "steps of the proof of Theorem 1: what comes of them is in (C.66) to (C.72)": [74, 77],
}


def test_every_equation_is_in_the_code_or_left_out_for_a_reason() -> None:
    packages = ("protocol", "plant_emulator", "service")
    code = "".join(path.read_text() for package in packages for path in (ROOT / package).rglob("*.py"))
    # "(C.16)–(C.49)" names a range and vouches for nothing between its ends: the ends of ranges do not count either.
    alone = re.sub(r"\(C\.\d+\)–\(C\.\d+\)", "", code)
    written = {int(number) for number in re.findall(r"\(C\.(\d+)\)", alone)}
    left_out = list(chain.from_iterable(LEFT_OUT.values()))
    assert len(left_out) == len(set(left_out))
    assert not written & set(left_out), "left out and written all the same"
    assert written | set(left_out) == set(range(1, 82))
