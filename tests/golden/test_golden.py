"""Stored logs read as they did: figures, findings and replays."""

from __future__ import annotations

import json
from math import isclose
from typing import Any, Final

import pytest

from tests.golden.make import HERE, LOGS, aeroloop, expected

FIGURES: Final = 1e-11
"""Relative tolerance of figures. NumPy sums and takes sines with the vector instructions of the processor, so the last
bits of a figure are the machine's (2e-13 between two of ours). Counts, texts and replayed bytes have no tolerance."""


def differences(stored: Any, found: Any, where: str = "") -> list[str]:
    """Values that are not the same, by their path."""
    if isinstance(stored, dict) and isinstance(found, dict):
        return [
            line
            for key in sorted(stored.keys() | found.keys())
            for line in differences(stored.get(key, "no key"), found.get(key, "no key"), f"{where}.{key}")
        ]
    if isinstance(stored, list) and isinstance(found, list) and len(stored) == len(found):
        return [
            line
            for i, pair in enumerate(zip(stored, found, strict=True))
            for line in differences(*pair, f"{where}[{i}]")
        ]
    if isinstance(stored, float) and isinstance(found, float) and isclose(stored, found, rel_tol=FIGURES):
        return []
    return [] if stored == found else [f"{where}: {stored!r} stored, {found!r} found"]


@pytest.mark.parametrize("name", LOGS)
def test_a_stored_log_gives_the_figures_findings_and_replays_that_it_gave(name: str) -> None:
    assert differences(json.loads((HERE / f"{name}.json").read_text()), expected(name)) == []


def test_the_stored_logs_are_checked_as_a_user_checks_logs() -> None:
    """The figures of the closed loops, which run again from the first tick, are those that were recorded."""
    found = aeroloop("log", "check", *(f"{name}.mcap" for name in LOGS))
    assert found["same"]
    for one in found["logs"]:
        assert one["commands"] > 0
        assert one["differ"] == one["plant_differ"] == 0
        if one["log"] != "can.mcap":  # its plant is a node
            stored, again = one["before"], one["after"]
            for name in ("z_track", "u_total", "max_error_deg"):
                assert isclose(stored[name], again[name], rel_tol=FIGURES)
