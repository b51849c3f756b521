"""Settings of all tests: no deadline per example of Hypothesis, because machines are busy; a state directory each."""

from __future__ import annotations

import os
import signal
from tempfile import TemporaryDirectory, mkdtemp
from typing import Final

import pytest
from hypothesis import settings

# Half as many examples as ever; in CI they are not random, so that more would be the same ones again and again.
settings.register_profile("untimed", parent=settings(), deadline=None, max_examples=50)
settings.load_profile("untimed")

_STATES: Final = TemporaryDirectory(prefix="aeroloop-tests-")
_SIGNALS: Final = signal.pthread_sigmask(signal.SIG_BLOCK, ())

REAL_TIME: Final = ("tests/hil/", "tests/can/test_buses.py", "testing/conformance/")
"""Where every test starts processes, and is one of real time unless it is marked `smoke`; elsewhere a test says so."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts processes and needs real time, which runs only with `-m realtime` (see pyproject.toml).

    Checks of types come first, as they take long. Real time comes last, when no other work keeps the cores busy.
    """
    smoke = {item.path for item in items if item.get_closest_marker("smoke") is not None}
    items.sort(key=lambda item: (item.path.name != "test_house.py", item.path in smoke))
    for item in items:
        if any(part in item.path.as_posix() for part in REAL_TIME):
            item.add_marker(pytest.mark.processes)
            if item.get_closest_marker("smoke") is None:
                item.add_marker(pytest.mark.realtime)


def pytest_runtest_setup() -> None:
    """Give the plants of each test a state directory of their own: no stop outlives its test."""
    os.environ["STATE_DIRECTORY"] = mkdtemp(dir=_STATES.name)


def pytest_runtest_teardown() -> None:
    """Unblock signals: a daemon's verb that a test runs in this process takes SIGTERM and SIGINT over."""
    signal.pthread_sigmask(signal.SIG_SETMASK, _SIGNALS)
