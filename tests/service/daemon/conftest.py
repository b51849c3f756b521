"""A controller's loop in a session, and the clock that it looks at."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from tests.support.operated_loop import LEVEL, FakeTime, Loop


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    """The fake clock in place of `time` wherever operator changes look at it."""
    return FakeTime(monkeypatch)


@pytest.fixture
def loop(time: FakeTime) -> Iterable[Loop]:  # noqa: ARG001  # the clock must stand still before OperatorChanges looks at it
    """A session at tick 0, level; whatever a test does to it, its log must run again."""
    loop = Loop(LEVEL)
    loop.begin()
    yield loop
    loop.assert_it_runs_again()
