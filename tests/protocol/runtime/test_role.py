"""Role on the network: which queries act."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status
from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.certificate import read_certificate
from aeroloop.protocol.transport.network import NetworkSettings, join
from aeroloop.protocol.transport.security import Identity, SecuritySettings
from aeroloop.service.host.operator import gather
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.zenoh_network import Gathering, eventually


def test_only_a_query_that_names_its_verb_acts() -> None:
    """Tools that list a network query `**`: a plant must be neither stopped nor armed by that."""
    done: list[str] = []
    with Gathering() as gathering, Role("plant", "aero", gathering.settings, {}) as role:

        def serve(verb: str) -> None:
            def act() -> Answer:
                done.append(verb)
                return Answer(done=True, text=verb)

            role.serve(verb, Request, lambda _: act)

        serve("arm")
        serve("stop")
        session = gathering.join()
        eventually("a link", lambda: any(session.get("aeroloop/aero/description/plant", timeout=1.0)))

        def answers(key: str) -> list[str]:
            got: list[str] = []
            session.get(
                key, lambda reply: got.append(str(reply.ok and reply.ok.key_expr)), target=zenoh.QueryTarget.ALL
            )
            eventually("an answer", lambda: not role.take_inbox() and bool(got))
            return got

        assert "aeroloop/aero/description/plant" in answers("**")
        assert done == []
        assert answers("aeroloop/*/stop") == ["aeroloop/aero/stop"]
        assert done == ["stop"]


def test_the_owner_has_an_event_of_each_peer_that_has_no_right_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One whose certificate is refused, as far as it listens; and one of another vehicle, which links."""
    monkeypatch.setattr("aeroloop.protocol.transport.refusal.FIRST_S", 0.0)
    monkeypatch.setattr("aeroloop.protocol.transport.refusal.EVERY_S", 0.0)
    ours, foreign = Authority(tmp_path / "ours"), Authority(tmp_path / "foreign")
    mine = read_certificate(ours.issue("plant", "aero"))
    for issue in (ours.issue, foreign.issue):
        issue("operator")
        issue("controller", "aero-2")
    network = NetworkSettings(
        rendezvous=[free_rendezvous()], security=SecuritySettings(directory=str(ours.folder)), loopback_secured=True
    )
    theirs = network.model_copy(update={"security": SecuritySettings(directory=str(foreign.folder))})
    other = Identity(("controller",), "aero-2")
    events = list[Event]()
    with join(network) as owner, Role("plant", "aero", network, {}) as role:
        owner.declare_subscriber(
            topics.key("event", "aero"),
            lambda sample: events.append(Event.model_validate_json(sample.payload.to_bytes())),
        )
        role.status(Status(role="plant", state="idle", uptime_s=0, ticks=0, rate_hz=0, skipped=0))
        assert gather(network).statuses["aero"]["plant"].certificate_until == mine.not_after
        with join(network, other), join(theirs, other):
            eventually("both events", lambda: len(events) >= 2)
    assert {event.kind for event in events} == {"refused"}
    texts = sorted(event.text for event in events)
    assert "links as controller/aero-2" in texts[0]
    assert "certificate is not of this authority" in texts[1]
    assert len(texts) == 2
