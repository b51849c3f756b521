"""FrameSession: a session of the frames alone, by QUIC, beside a plant's places, for networks beyond loopback."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from aeroloop.protocol.messages.topics import key
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.transport.network import FrameSession
from aeroloop.protocol.transport.network_settings import Endpoint, Identity, NetworkSettings, SecuritySettings
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.zenoh_network import Gathering, eventually

PLANT, CONTROLLER = Identity(("plant",), "aero"), Identity(("controller",), "aero")
MEASUREMENT, COMMAND = (key(name, "aero", session="s") for name in ("measurement", "command"))
FAR = "tcp/192.0.2.1:7447"


@pytest.fixture
def beyond(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback counts as a network beyond it, so that one host will do."""
    monkeypatch.setattr(Endpoint, "leaves_host", property(lambda endpoint: endpoint.protocol in ("tcp", "tls")))


@pytest.fixture(params=["plain", "certificates"])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[FrameSession, FrameSession]]:
    """A plant's, which listens, and a controller's, which is connected to it."""
    request.getfixturevalue("beyond")
    settings = NetworkSettings(rendezvous=[free_rendezvous()], insecure=True)
    if request.param == "certificates":
        authority = Authority(tmp_path / "keys")
        for role in ("plant", "controller"):
            authority.issue(role, "aero")
        security = SecuritySettings(directory=str(authority.folder))
        settings = NetworkSettings(rendezvous=[free_rendezvous("tls")], security=security)
    plant, controller = FrameSession(settings, PLANT), FrameSession(settings, CONTROLLER)
    plant.listen()
    eventually("a link", lambda: bool(controller.connect(plant.endpoint)))
    assert plant.endpoint.startswith("quic/" if request.param == "certificates" else "udp/")
    yield plant, controller
    controller.close()
    plant.close()


def test_a_plant_takes_and_sends_frames_on_either_session(pair: tuple[FrameSession, FrameSession]) -> None:
    with Gathering() as gathering:
        main, other = gathering.join(), gathering.join()
        plant = ZenohLink(main, MEASUREMENT, COMMAND, range(256), also=pair[0].session)
        for session in (other, pair[1].session):
            assert session is not None
            controller = ZenohLink(session, COMMAND, MEASUREMENT, range(256))

            def there_and_back(link: ZenohLink = controller) -> bool:
                link.send(b"command")
                plant.send(b"measurement")
                there, back = plant.take(), link.take()
                return there is not None and back is not None

            eventually("a frame each way", there_and_back)
            controller.close()
        plant.close()


def test_on_loopback_where_not_wanted_and_at_an_endpoint_that_is_not_of_the_network_there_are_none() -> None:
    for settings in (NetworkSettings(), NetworkSettings(transport="tcp", rendezvous=[FAR], insecure=True)):
        plant = FrameSession(settings, PLANT)
        plant.listen()
        assert not plant.wanted
        assert (plant.session, plant.endpoint) == (None, "")
    controller = FrameSession(NetworkSettings(rendezvous=[FAR], insecure=True), CONTROLLER)
    assert controller.wanted
    assert controller.connect("udp/192.0.2.2:7447?rel=1;mixed_rel=1") is False
    assert controller.session is None


@pytest.mark.usefixtures("beyond")
def test_a_link_that_does_not_come_about_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FrameSession, "LINK_S", 0.01)
    settings = NetworkSettings(rendezvous=[free_rendezvous()], insecure=True)
    controller = FrameSession(settings, CONTROLLER)
    eventually(
        "giving up",
        lambda: controller.connect(f"udp/{settings.rendezvous_endpoints[0][4:]}?rel=1;mixed_rel=1") is False,
    )
    controller.close()
