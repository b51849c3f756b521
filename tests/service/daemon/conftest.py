"""A controller's loop in a session."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from tests.support.operated_loop import LEVEL, Loop


@pytest.fixture
def loop() -> Iterable[Loop]:
    """A session at tick 0, level; whatever a test does to it, its log must run again."""
    loop = Loop(LEVEL)
    loop.begin()
    yield loop
    loop.assert_it_runs_again()
