"""Hypothesis settings of all tests: no deadline per example, because machines are busy."""

from __future__ import annotations

import pytest
from hypothesis import settings

# Half as many examples as ever; in CI they are not random, so that more would be the same ones again and again.
settings.register_profile("untimed", parent=settings(), deadline=None, max_examples=50)
settings.load_profile("untimed")

PROCESSES = ("tests/hil/", "tests/can/test_buses.py", "tests/can/test_socketcan.py", "testing/conformance/")
"""Where every test starts processes; elsewhere a test says so by itself."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts processes: `-m "not processes"` is the fast loop. Checks of types come first."""
    items.sort(key=lambda item: item.path.name != "test_house.py")  # last, they would keep one core while others idle
    for item in items:
        if any(part in item.path.as_posix() for part in PROCESSES):
            item.add_marker(pytest.mark.processes)
