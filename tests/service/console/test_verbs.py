"""Verbs of the console: what a page asks for is asked of the vehicle that it names, and of no other."""

from __future__ import annotations

from unittest.mock import MagicMock

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.service.config import load
from aeroloop.service.console import verbs
from aeroloop.service.console.feed import Feed
from aeroloop.service.console.verbs import PageRequest, Verbs
from aeroloop.service.host.operator import Stopped


@pytest.mark.parametrize(("vehicle", "asked"), [("aero", ["aero"]), ("beta", ["beta"]), ("", ["aero", "beta"])])
def test_a_stop_goes_first_to_the_plants_that_are_known_of_the_vehicle(
    monkeypatch: pytest.MonkeyPatch, vehicle: str, asked: list[str]
) -> None:
    """To all of them where no vehicle is named; a vehicle without a plant has none to stop."""
    feed, stopped = Feed(), list[tuple[str, list[str]]]()
    for name, role in (("aero", "plant"), ("beta", "plant"), ("gamma", "controller")):
        status = Status(role=role, state="driven", uptime_s=1, ticks=0, rate_hz=0, skipped=0)
        feed.take(topics.key("status", name, role=role), status.encode(), 0.0, 0.0)

    def stop_by(_here: object, _network: object, name: str, known: list[str]) -> Stopped:
        stopped.append((name, known))
        return Stopped(["at 0 V"], [])

    monkeypatch.setattr(verbs, "stop_by", stop_by)
    done = Verbs(load().network, MagicMock(), feed).do(PageRequest(verb="stop", vehicle=vehicle))
    assert stopped == [(vehicle or "*", asked)]
    assert done == {"answers": ["at 0 V"], "failures": []}
