"""A clock that tests move by hand, in place of the plant's and the board's."""

from __future__ import annotations

import pytest

from aeroloop.plant_emulator.hosts.quanser import fake, usb


class HandClock:
    """Takes the place of the module `time`; sleeping takes no time but its own."""

    def __init__(self) -> None:
        self.ns = 10**9
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        """The time [ns]."""
        return self.ns

    def sleep(self, seconds: float) -> None:
        """Move the time on."""
        self.slept.append(seconds)
        self.ns += round(seconds * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> HandClock:
    """The clock of plant and board."""
    hand = HandClock()
    monkeypatch.setattr(usb, "time", hand)
    monkeypatch.setattr(fake, "time", hand)
    return hand
