"""Throttle: the first of a kind passes at once, and what is held back is counted."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from aeroloop.protocol.runtime import throttle
from aeroloop.protocol.runtime.throttle import Throttle


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The time `now` [s], which moves only when set; it starts just after the machine has."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(throttle, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_the_first_of_a_kind_passes_and_what_follows_is_held_back_and_counted(clock: SimpleNamespace) -> None:
    throttle, passed = Throttle(10.0), []
    for now, kind in ((0, "a"), (1, "a"), (5, "b"), (9.75, "a"), (10, "a"), (10, "a"), (14, "b"), (20, "a")):
        clock.now = now
        passed.append(throttle.let_pass(kind))
    assert passed == [0, None, 0, None, 2, None, None, 1]


def test_a_throttle_is_of_bounded_size_however_many_kinds_there_are(clock: SimpleNamespace) -> None:
    throttle = Throttle(10.0)
    sizes = set()
    for i in range(5 * Throttle.MAX_KINDS):
        clock.now += 1e-3
        assert throttle.let_pass(f"from {i}") == 0
        sizes.add(sum(len(kept) for kept in vars(throttle).values() if isinstance(kept, dict)))
    assert max(sizes) == Throttle.MAX_KINDS
