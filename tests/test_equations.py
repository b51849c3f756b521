"""Every equation of the paper, (C.1)–(C.81), is in the code under its number, or left out for a reason given here."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parent.parent

LEFT_OUT = {
    "a bound of the stability analysis, not a part of the loop": [26, 27],
    "the Lyapunov function; it stands in the proof of (C.25), tests/service/test_law.py": [24],
    "Lemma 1 and its proof: bounds for the certificate, which is not built yet": [*range(50, 66)],
    "Theorem 1 and its proof: the certificate's condition and radius, not built yet": [*range(66, 78)],
    "Corollary 1: the certificate's radius under a disturbance, not built yet": [79, 80],
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
