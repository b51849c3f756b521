"""Links, mailboxes and sessions of frames alone: the newest frame, once, and no queue."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages.topics import key
from aeroloop.protocol.transport.link import Link, Mailbox, ZenohLink
from aeroloop.protocol.transport.network import FrameSession
from aeroloop.protocol.transport.network_settings import Endpoint, Identity, NetworkSettings, SecuritySettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy, Transmit
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

Sessions = tuple[zenoh.Session, zenoh.Session]
SETTLE_S = 0.05
"""What should not arrive would have arrived by then: a frame takes less than a millisecond."""


@given(depth=st.integers(1, 3), frames=st.lists(st.none() | st.binary(max_size=2)))
def test_a_mailbox_gives_each_frame_once_and_a_new_one_replaces_the_oldest(
    depth: int, frames: list[bytes | None]
) -> None:
    """None takes a frame, with and without waiting for it."""
    mailbox, expected, since = Mailbox(depth=depth), deque[bytes](maxlen=depth), time.monotonic_ns()
    for i, frame in enumerate(frames):
        assert mailbox.pending == bool(expected)
        if frame is not None:
            mailbox.put(frame)
            expected.append(frame)
        elif (arrival := mailbox.wait(0.0) if i % 2 else mailbox.take()) is not None:
            assert arrival.frame == expected.popleft()
            assert since <= arrival.at_ns <= time.monotonic_ns()
            since = arrival.at_ns
        else:
            assert not expected


def receive(at: Link | Mailbox, wait_s: float = PATIENCE_S) -> bytes | None:
    arrival = at.wait(wait_s)
    return None if arrival is None else arrival.frame


@pytest.fixture
def pair() -> Iterator[Sessions]:
    with Gathering() as gathering:
        a, b = gathering.join(), gathering.join()
        eventually("meeting", lambda: bool(a.info.peers_zid()) and bool(b.info.peers_zid()))
        yield a, b


def any_frame(_: bytes) -> bool:
    return True


def links(
    pair: Sessions, session: str = "s1", *, lossless: bool = True, accepts: Callable[[bytes], bool] = any_frame
) -> tuple[ZenohLink, ZenohLink]:
    """Both ends of a link, connected in both directions. Lossless, so that a slow machine drops nothing."""
    plant = ZenohLink(pair[0], f"t/{session}/measurement", f"t/{session}/command", accepts, lossless=lossless)
    controller = ZenohLink(pair[1], f"t/{session}/command", f"t/{session}/measurement", accepts, lossless=lossless)
    for sender, receiver in ((plant, controller), (controller, plant)):  # a put right after a subscription may be lost

        def received(sender: Link = sender, receiver: Link = receiver) -> bool:
            sender.send(b"hello")
            return receive(receiver, 0.05) is not None

        eventually("the first frame", received)
        sender.send(b"ready")
        eventually("the last", lambda r=receiver: (got := r.take()) is not None and got.frame == b"ready")  # type: ignore[misc]  # bound now
    return plant, controller


@pytest.mark.parametrize("lossless", [True, False])
def test_frames_arrive_both_ways_as_they_were_sent_and_what_is_not_accepted_displaces_none(
    pair: Sessions, lossless: bool
) -> None:
    plant, controller = links(pair, lossless=lossless, accepts=lambda frame: len(frame) in (5, 0))
    for sender, receiver in ((plant, controller), (controller, plant)) * 20:
        for frame in (b"good!", b""):
            before, refused = time.monotonic_ns(), receiver.refused
            for sent in (b"long..", frame, b"four", bytes(200)) if lossless else (frame,):
                sender.send(sent)
            arrival = receiver.wait(PATIENCE_S)
            assert arrival is not None
            assert arrival.frame == frame
            assert before <= arrival.at_ns <= time.monotonic_ns()
            if lossless:
                eventually("the refusals", lambda r=receiver, n=refused: r.refused == n + 3)  # type: ignore[misc]
            assert receiver.take() is None


def test_in_real_time_no_frame_that_cannot_be_read_displaces_one_that_can(pair: Sessions) -> None:
    """Junk of the right length in the place of commands, 1 000 a second, tripped the plant in 6 s."""
    wire = WireSpec()
    good = wire.command.pack(7, (5, -5))
    junk = good[:-1] + bytes([good[-1] | 1])  # a padding bit is set
    accepts = {lockstep: wire.acceptance("command", lockstep=lockstep) for lockstep in (False, True)}
    assert len(junk) == len(good)
    assert accepts[True](junk)  # it counts as the answer that was due
    plant = ZenohLink(pair[0], "t/s1/measurement", "t/s1/command", accepts[False])
    controller = ZenohLink(pair[1], "t/s1/command", "t/s1/measurement", any_frame, lossless=True)

    def received() -> bool:
        controller.send(good)
        return receive(plant, 0.05) == good

    eventually("the first frame", received)
    for frame in (junk, good, junk, junk):
        controller.send(frame)
    eventually("the refusals", lambda: plant.refused == 3)
    assert receive(plant) == good
    assert plant.take() is None


@pytest.mark.parametrize("direction", ["measurement", "command"])
@pytest.mark.parametrize("policy", ["periodic", "on_change"])
def test_an_empty_frame_is_accepted_in_lockstep_on_change_alone(
    direction: Literal["measurement", "command"], policy: Policy
) -> None:
    wire = WireSpec(transmit=Transmit.model_validate({direction: policy}))
    accepted = {lockstep: wire.acceptance(direction, lockstep=lockstep)(UNCHANGED) for lockstep in (False, True)}
    assert accepted == {False: False, True: policy == "on_change"}


def test_a_link_receives_only_its_own_session_and_nothing_once_it_is_closed(pair: Sessions) -> None:
    plant, controller = links(pair)
    other_plant, other_controller = links(pair, "s2")
    other_plant.send(b"theirs")
    assert receive(other_controller) == b"theirs"
    assert controller.wait(SETTLE_S) is None
    controller.close()
    controller.close()
    plant.send(b"late")
    other_plant.send(b"after it")
    assert receive(other_controller) == b"after it"  # the sessions outlive the link
    assert controller.wait(SETTLE_S) is None


# ── FrameSession: a session of the frames alone, by QUIC, beside a plant's places, for networks beyond loopback ──


PLANT, CONTROLLER = Identity(("plant",), "aero"), Identity(("controller",), "aero")
MEASUREMENT, COMMAND = (key(name, "aero", session="s") for name in ("measurement", "command"))
FAR = "tcp/192.0.2.1:7447"


@pytest.fixture
def beyond(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback counts as a network beyond it, so that one host will do."""
    monkeypatch.setattr(Endpoint, "leaves_host", property(lambda endpoint: endpoint.protocol in ("tcp", "tls")))


@pytest.fixture(params=["plain", "certificates"])
def frame_sessions(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[FrameSession, FrameSession]]:
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


def test_a_plant_takes_and_sends_frames_on_either_session(frame_sessions: tuple[FrameSession, FrameSession]) -> None:
    with Gathering() as gathering:
        main, other = gathering.join(), gathering.join()
        plant = ZenohLink(main, MEASUREMENT, COMMAND, any_frame, also=frame_sessions[0].session)
        for session in (other, frame_sessions[1].session):
            assert session is not None
            controller = ZenohLink(session, COMMAND, MEASUREMENT, any_frame)

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
