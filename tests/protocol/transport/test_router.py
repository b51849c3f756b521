"""Router: clients link to it and to nothing else, wait for it, and go on where they were when it is back."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.certificate import OF_ONE_VEHICLE
from aeroloop.protocol.transport.history import CachedPublisher, RecoveringSubscriber
from aeroloop.protocol.transport.network import command_session, join, route
from aeroloop.protocol.transport.network_settings import Identity, NetworkError, NetworkSettings, SecuritySettings
from aeroloop.service.host.operator import gather, stop
from tests.protocol.transport.test_network import Listener, receives
from tests.support.certificates import Authority
from tests.support.zenoh_network import eventually, free_port

ROUTER, SPEAKER = Identity(("router",)), Identity(("controller",), "aero")
WORD, ALIVE = topics.key("telemetry", "aero"), topics.key("alive", "aero", role="controller-1-abcd")
"""What a controller may publish and hold, and an operator receive."""


def of(authority: Authority) -> NetworkSettings:
    """A network of clients with certificates of an authority, which are issued here."""
    for role in ("router", "operator", "recorder", "plant", "controller"):
        authority.issue(role, "aero" if role in OF_ONE_VEHICLE else None)
    security = SecuritySettings(directory=str(authority.folder), vehicles=["aero"])
    return NetworkSettings(mode="client", rendezvous=[f"tls/127.0.0.1:{free_port()}"], security=security)


@pytest.fixture(params=["tcp", "tls"])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> NetworkSettings:
    """Of clients and their router, in plain text and with certificates."""
    if request.param == "tls":
        return of(Authority(tmp_path))
    return NetworkSettings(mode="client", rendezvous=[f"tcp/127.0.0.1:{free_port()}"])


@pytest.fixture
def open_sessions() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_clients_link_to_the_router_alone_and_receive_through_it(
    settings: NetworkSettings, open_sessions: ExitStack
) -> None:
    router = open_sessions.enter_context(closing(route(settings, ROUTER)))
    ear = Listener(open_sessions.enter_context(closing(join(settings))), WORD)
    for client in [open_sessions.enter_context(closing(join(settings, SPEAKER))) for _ in range(2)]:
        receives(ear, client, str(client.zid()).encode(), WORD)
        assert [str(link.dst) for link in client.info.links()] == settings.rendezvous
        assert list(client.info.routers_zid()) == [router.zid()]
        assert not list(client.info.peers_zid())
    assert set(ear.stamped) == {False}  # a router stamps messages by default


def test_a_client_that_starts_first_waits_for_the_router_and_a_command_names_it(
    settings: NetworkSettings, open_sessions: ExitStack
) -> None:
    joined: list[zenoh.Session] = []
    thread = threading.Thread(target=lambda: joined.append(join(settings)))
    thread.start()
    with pytest.raises(NetworkError) as caught, command_session(settings):
        pass
    assert str(caught.value) == f"no router answers at {settings.rendezvous[0]}; is `aeroloop router` running?"
    assert not joined
    open_sessions.enter_context(closing(route(settings, ROUTER)))
    thread.join()
    open_sessions.enter_context(closing(joined[0]))
    with command_session(settings) as here:
        here.wait_for_links()
        assert here.unanswered() == []


def test_a_command_names_a_router_that_hangs(settings: NetworkSettings) -> None:
    with (
        socket.create_server(("127.0.0.1", int(settings.rendezvous[0].rpartition(":")[2]))),
        pytest.raises(NetworkError, match="accepts connections and does not answer as a router"),
        command_session(settings),
    ):
        pass


def test_what_was_published_while_the_router_was_away_is_recovered(
    settings: NetworkSettings, open_sessions: ExitStack
) -> None:
    """Its cache holds it. Tokens that were declared before are seen again, too."""
    router = route(settings, ROUTER)
    speaker = open_sessions.enter_context(closing(join(settings, SPEAKER)))
    listener = open_sessions.enter_context(closing(join(settings)))
    publisher, subscriber = CachedPublisher(speaker, WORD), RecoveringSubscriber(listener, WORD)
    tokens: list[zenoh.SampleKind] = []
    seen = listener.liveliness().declare_subscriber(ALIVE, lambda token: tokens.append(token.kind), history=True)
    token = speaker.liveliness().declare_token(ALIVE)
    received: list[bytes] = []

    def arrived(*words: bytes) -> bool:
        received.extend(delivery.payload for delivery in subscriber.take())
        return received == list(words)

    publisher.put(b"before")
    eventually("the first", lambda: arrived(b"before"))
    router.close()
    eventually("the token's end", lambda: tokens == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE])
    publisher.put(b"away")
    with closing(route(settings, ROUTER)):
        eventually("the second", lambda: arrived(b"before", b"away"))
        eventually("the token", lambda: len(tokens) == 3)
        publisher.put(b"again")
        eventually("the third", lambda: arrived(b"before", b"away", b"again"))
    assert subscriber.losses() == []
    seen.undeclare()
    token.undeclare()


def test_a_stop_of_all_fails_for_a_vehicle_whose_plant_a_router_has_forgotten(
    settings: NetworkSettings, open_sessions: ExitStack
) -> None:
    """A plant that hangs is off a router's network after a second, and nothing else names it."""
    open_sessions.enter_context(closing(route(settings, ROUTER)))
    member = open_sessions.enter_context(closing(join(settings, SPEAKER)))
    token = member.liveliness().declare_token(ALIVE)
    assert stop(settings, patience_s=0).failures == ["aero has a controller, and no plant of it answers"]
    token.undeclare()


def test_roles_keep_to_their_rights_over_a_router(tmp_path: Path, open_sessions: ExitStack) -> None:
    """The router has rules, too: a claim of the controller passes it, one of a recorder does not."""
    network = of(Authority(tmp_path))
    names = ("router", "plant", "controller", "recorder")
    roles = {name: open_sessions.enter_context(Node(name, "aero", network, {})) for name in names}
    claims: list[bytes] = []
    key = topics.key("claim", "aero")

    def answer(query: zenoh.Query) -> None:
        claims.append(query.payload.to_bytes() if query.payload else b"")
        query.reply(key, b"granted")

    roles["plant"].zenoh.declare_queryable(key, answer, complete=True)
    for each in roles.values():
        each.announce()
        each.status(Status(role=each.role, state="idle", uptime_s=0.0, ticks=0, rate_hz=0.0, skipped=0))

    def answers(role: str) -> list[bytes]:
        replies = roles[role].zenoh.get(key, payload=role.encode(), timeout=1.0)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    eventually("the claim", lambda: answers("controller") == [b"granted"])
    assert answers("recorder") == []
    assert set(claims) == {b"controller"}
    assert set(gather(network).statuses["aero"]) == set(names)
