"""Session of the frames: where a plant listens by datagrams, a controller connects once, and a stop is answered."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.network import FrameSession, command_session
from aeroloop.protocol.transport.network_settings import Identity, NetworkSettings
from aeroloop.service.host.operator import stop
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.zenoh_network import PATIENCE_S, eventually

LINK_S = 2.0  # of a handshake on a busy machine; closing the session waits for those at ports where nothing listens
PLANT, CONTROLLER = Identity(("plant",), "aero"), Identity(("controller",), "aero")


@pytest.fixture
def settings() -> NetworkSettings:
    """Of a network by this host's name, which counts as one beyond this host."""
    name = socket.gethostname()
    with suppress(OSError):
        socket.getaddrinfo(name, 0, socket.AF_INET)
        port = free_rendezvous().rpartition(":")[2]
        return NetworkSettings(rendezvous=[f"tcp/{name}:{port}"], insecure=True)
    pytest.skip(f"this host's name, {name}, has no address")


@contextmanager
def frames(settings: NetworkSettings, identity: Identity) -> Iterator[FrameSession]:
    with closing(FrameSession(settings, identity)) as session:
        yield session


def test_a_controller_connects_once_to_an_endpoint_and_anew_after_a_session(settings: NetworkSettings) -> None:
    with frames(settings, PLANT) as plant, frames(settings, CONTROLLER) as controller:
        plant.listen()
        assert plant.endpoint.startswith("udp/")
        eventually("a link", lambda: controller.connect(plant.endpoint) is True)
        session = controller.session
        assert controller.connect(plant.endpoint) is True
        assert controller.session is session
        controller.close()  # at a session's end
        assert not controller.linked
        eventually("a link anew", lambda: controller.connect(plant.endpoint) is True)
        assert controller.session is not session


def test_a_controller_s_datagrams_follow_a_plant_that_listens_elsewhere(settings: NetworkSettings) -> None:
    with frames(settings, PLANT) as first, frames(settings, PLANT) as second:
        first.listen()
        second.listen()
        assert second.endpoint not in ("", first.endpoint)
        with frames(settings, CONTROLLER) as controller:
            for place in (first, second):
                eventually("a link", lambda p=place: controller.connect(p.endpoint) is True)  # type: ignore[misc]  # bound now
                assert controller.session is not None
                assert place.session is not None
                assert list(controller.session.info.peers_zid()) == [place.session.zid()]


def test_a_status_from_elsewhere_leads_nowhere(settings: NetworkSettings) -> None:
    with frames(settings, CONTROLLER) as controller:
        assert controller.connect("udp/192.0.2.1:7447?rel=1;mixed_rel=1") is False
        assert controller.session is None


def test_a_plant_answers_a_stop_by_datagrams_where_no_tcp_port_lets_an_operator_in(settings: NetworkSettings) -> None:
    """The command has no TCP endpoint of the plant's; nothing but the stop and the token is there."""
    with Node("plant", "aero", settings, {}) as role:
        role.datagrams.listen()
        stopped: list[Request] = []

        def act(request: Request) -> Answer:
            stopped.append(request)
            return Answer(done=True, text="aero is at 0 V")

        role.serve("arm", Request, lambda _: Answer(done=True, text="armed"))
        role.serve("stop", Request, act, by_datagrams=True)
        role.announce()
        tcp = role.zenoh
        with command_session(settings, LINK_S, by_datagrams=True) as here:
            eventually("both links", lambda: len(here.session.info.peers_zid()) == 2)
        tcp.close()
        assert stop(settings, "aero", patience_s=PATIENCE_S) == (["aero is at 0 V"], [])
        assert stopped == [Request()]
        with command_session(settings, LINK_S, by_datagrams=True) as here:
            assert role.datagrams.session is not None
            zid = role.datagrams.session.zid()
            eventually("the link", lambda: zid in here.session.info.peers_zid())
            assert not [reply for reply in here.session.get(topics.key("arm", "aero"), timeout=1.0) if reply.ok]
