"""Each test has Quanser's package or not, whatever the test before it; and a clock that a test moves by hand."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from aeroloop.plant_emulator.hosts import quanser_board
from tests.support import fake_quanser
from tests.support.clock import FakeClock


@pytest.fixture(autouse=True)
def no_package() -> Iterator[None]:
    """Remove the fake package that a test has put in the place of Quanser's."""
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "quanser"]:
        del sys.modules[name]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    hand = FakeClock()
    monkeypatch.setattr(quanser_board, "time", hand)
    monkeypatch.setattr(fake_quanser, "time", hand)
    return hand
