"""A clock that tests move by hand, in place of the plant's and the board's."""

from __future__ import annotations

import pytest

from aeroloop.plant_emulator.hosts.quanser import fake, usb
from tests.support.quanser_board import HandClock


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> HandClock:
    """The clock of plant and board."""
    hand = HandClock()
    monkeypatch.setattr(usb, "time", hand)
    monkeypatch.setattr(fake, "time", hand)
    return hand
