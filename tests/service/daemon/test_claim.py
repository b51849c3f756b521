"""Claim protocol, controller side: every record reaches the plant, and frames travel by what the plant takes."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Grant, Refusal, SessionRecord, Status
from aeroloop.protocol.messages.operator import Answer, Gains, Hold, Message
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.daemon import claim
from aeroloop.service.daemon.claim import ClaimClient


def record(yaw: float) -> SessionRecord:
    return SessionRecord(
        controller="c", session="s", gains=Gains(), gains_from="configured", reference=Hold(attitude=(0.0, 0.0, yaw)),
        reference_from="operator", within_s=0.0, since_tick=0,
    )  # fmt: skip


def claims_of(zenoh: Any, **role: Any) -> ClaimClient:
    """The claims of a controller on a network."""
    known = {"vehicle": "aero", "name": "c", "datagrams": SimpleNamespace(wanted=False)}
    node = cast(Node, SimpleNamespace(zenoh=zenoh, **known | role))
    return ClaimClient(node, LoopSettings(), WireSpec(), auto_arm=False)


def test_a_record_is_sent_until_the_plant_has_answered_and_then_only_when_it_changes() -> None:
    sent = list[tuple[str, SessionRecord]]()
    handlers = list[Callable[[Any], None]]()

    def get(key: str, handler: Callable[[Any], None], *, payload: bytes, **_: object) -> None:
        sent.append((key, SessionRecord.model_validate_json(payload)))
        handlers.append(handler)

    def reply(answer: Answer) -> None:
        handlers[-1](SimpleNamespace(ok=SimpleNamespace(payload=_bytes(answer.encode()))))

    claims = claims_of(SimpleNamespace(get=get))
    first, second = record(1.0), record(2.0)
    claims.keep(first)
    assert sent == []  # no session runs
    claims.session = "s"
    claims.keep(first)
    claims.keep(first)
    handlers[-1](SimpleNamespace(ok=None))  # a time-out
    claims.keep(first)
    assert sent == [(topics.key("record", "aero"), first)] * 3
    reply(Answer(done=False, text="busy"))
    claims.keep(first)
    assert sent[3:] == [(topics.key("record", "aero"), first)]
    reply(Answer(done=True, text="kept"))
    claims.keep(first)
    assert len(sent) == 4
    claims.keep(second)
    assert sent[4:] == [(topics.key("record", "aero"), second)]


class Plant:
    def __init__(self, status: bytes | None, claim: Message | None = None) -> None:
        answer = (claim or Grant(session="s")).encode()
        self.answers = {} if status is None else {"status": status, "claim": answer}

    def get(self, key: str, **_: object) -> list[SimpleNamespace]:
        answers = [answer for topic, answer in self.answers.items() if f"/{topic}" in key]
        timed_out = [SimpleNamespace(ok=None)]  # Zenoh's reply for a query that is not answered in time
        return [SimpleNamespace(ok=SimpleNamespace(payload=_bytes(answer))) for answer in answers] or timed_out


def test_a_refusal_is_an_event_once_and_stays_known_until_a_grant(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that an operator's request can be answered with it: "stopped; `op arm` clears it"."""
    link, events = SimpleNamespace(close=lambda: None), list[str]()
    monkeypatch.setattr(claim, "ZenohLink", lambda *_, **__: link)
    plant = Plant(b"", Refusal(reason="stopped"))
    claims = claims_of(plant, event=lambda _kind, text, _session: events.append(text))
    for _ in range(3):
        assert claims.claim() is None
        assert (claims.refusal, events) == ("stopped", ["aero refuses: stopped"])
    plant.answers["claim"] = Grant(session="s").encode()
    assert claims.claim() is not None
    assert claims.refusal == ""


def _bytes(payload: bytes) -> SimpleNamespace:
    return SimpleNamespace(to_bytes=lambda: payload)  # as Zenoh hands them over


@pytest.mark.parametrize(
    ("endpoint", "passes", "carrier"),
    [
        ("udp/h:1", True, "datagrams"),
        ("udp/h:1", False, "first"),
        ("udp/h:1", None, "none"),
        ("", True, "first"),
        (None, True, "none"),
    ],
    ids=["it takes datagrams", "none pass", "not linked yet", "it takes none", "no plant answers"],
)
def test_a_claims_frames_travel_by_datagrams_where_the_plant_takes_them(
    monkeypatch: pytest.MonkeyPatch, endpoint: str | None, passes: bool | None, carrier: str
) -> None:
    status = None if endpoint is None else Status(
        role="plant", state="idle", uptime_s=0, ticks=0, rate_hz=0, skipped=0, datagrams=endpoint
    ).encode()  # fmt: skip
    first, datagrams, warned = Plant(status), SimpleNamespace(name="datagrams"), []
    asked = SimpleNamespace(wanted=True, linked=False, connect=lambda _: passes, session=datagrams)
    used: list[object] = []

    def link(session: object, **_: object) -> object:
        used.append(session)
        return object()

    monkeypatch.setattr(claim, "ZenohLink", link)
    claims = claims_of(first, datagrams=asked, warn=lambda *words: warned.append(words[-1]))
    assert (claims.claim() is not None) == (carrier != "none")
    assert used == {"datagrams": [datagrams], "first": [first], "none": []}[carrier]
    assert claims.by_datagrams == (carrier == "datagrams")
    assert bool(warned) == (passes is False)
