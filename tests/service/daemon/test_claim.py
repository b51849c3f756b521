"""Claim protocol, controller side: the plant gets every record of the session, also where an answer is lost."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Answer, Gains, Hold
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.daemon.claim import ClaimClient


class Queries:
    """A Zenoh session that keeps queries and the callback for their answers."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, SessionRecord]] = []
        self.answer: Callable[[Any], None] = lambda _: None

    def get(self, key: str, handler: Callable[[Any], None], *, payload: bytes, **_: object) -> None:
        """Keep the query; it is answered by the test, or never."""
        self.sent.append((key, SessionRecord.model_validate_json(payload)))
        self.answer = handler


def record(yaw: float) -> SessionRecord:
    """Of a session s."""
    return SessionRecord(
        controller="c", session="s", gains=Gains(), gains_from="configured", reference=Hold(attitude=(0.0, 0.0, yaw)),
        reference_from="operator", within_s=0.0, since_tick=0,
    )  # fmt: skip


def reply(answer: Answer) -> SimpleNamespace:
    return SimpleNamespace(ok=SimpleNamespace(payload=SimpleNamespace(to_bytes=answer.encode)))


def test_a_record_is_sent_until_the_plant_has_answered_and_then_only_when_it_changes() -> None:
    queries = Queries()
    role = cast(Role, SimpleNamespace(zenoh=queries, vehicle="aero"))
    claims = ClaimClient(role, LoopSettings(), WireSpec(), auto_arm=False, own_grid=False)
    first, second = record(1.0), record(2.0)
    claims.keep(first)
    assert queries.sent == []  # no session runs
    claims.session = "s"
    claims.keep(first)
    claims.keep(first)
    queries.answer(SimpleNamespace(ok=None))  # a time-out
    claims.keep(first)
    assert queries.sent == [(topics.key("record", "aero"), first)] * 3
    queries.answer(reply(Answer(done=False, text="a request as long as this one was taken 2 s ago")))
    claims.keep(first)
    assert queries.sent[3:] == [(topics.key("record", "aero"), first)]
    queries.answer(reply(Answer(done=True, text="kept")))
    claims.keep(first)
    assert len(queries.sent) == 4
    claims.keep(second)
    assert queries.sent[4:] == [(topics.key("record", "aero"), second)]
