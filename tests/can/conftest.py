"""Fixtures of tests on a CAN bus inside this process."""

from __future__ import annotations

import pytest

from tests.support.can_in_process import Flaws


@pytest.fixture
def flaws(monkeypatch: pytest.MonkeyPatch) -> Flaws:
    """Every link that is opened from now on is on a virtual bus that fails as they say."""
    flaws = Flaws()
    monkeypatch.setattr("aeroloop.protocol.transport.can_link.can.Bus", flaws.bus)
    return flaws
