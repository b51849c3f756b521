"""Network: peers meet at a rendezvous that any of them holds, and an endpoint in use is a one-line error."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh
from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import TOPICS, Topic
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.network import NetworkError, NetworkSettings
from tests.support.zenoh_network import Gathering, accepts, eventually, free_port


class Listener:
    """What a session receives on a key."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.received: set[bytes] = set()
        self.stamped: list[bool] = []
        self._subscriber = session.declare_subscriber(key, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        self.stamped.append(sample.timestamp is not None)
        self.received.add(sample.payload.to_bytes())


def receives(listener: Listener, speaker: zenoh.Session, word: bytes) -> None:
    """Publish a word until it is received: the first may go before the subscription is known."""

    def said() -> bool:
        speaker.put("t/word", word)
        return word in listener.received

    eventually(f"receiving {word!r}", said)


def test_the_first_to_start_listens_at_the_rendezvous_and_the_others_join() -> None:
    with Gathering() as gathering:
        assert not accepts(gathering.port)
        first = gathering.join()
        assert accepts(gathering.port)
        second, third = gathering.join(), gathering.join()
        everyone = {first, second, third}
        for member in everyone:
            others = {str(other.zid()) for other in everyone - {member}}
            eventually("meeting", lambda m=member, o=others: {str(zid) for zid in m.info.peers_zid()} == o)  # type: ignore[misc]  # bound now
        listener = Listener(third, "t/word")
        receives(listener, first, b"from the first")
        receives(listener, second, b"from the second")


def test_when_the_holder_goes_the_rest_stay_together_and_the_next_takes_the_rendezvous() -> None:
    with Gathering() as gathering:
        holder, b, c = gathering.join(), gathering.join(), gathering.join()
        listeners = {name: Listener(member, "t/word") for name, member in (("b", b), ("c", c))}
        receives(listeners["b"], c, b"before")
        holder.close()
        eventually("the holder's leaving", lambda: not accepts(gathering.port))
        receives(listeners["b"], c, b"c to b, without a holder")
        receives(listeners["c"], b, b"b to c, without a holder")
        newcomer = gathering.join()
        assert accepts(gathering.port)
        listener = Listener(newcomer, "t/word")
        for name, each in listeners.items():
            receives(each, newcomer, f"the newcomer to {name}".encode())
        receives(listener, b, b"b to the newcomer")
        receives(listener, c, b"c to the newcomer")


@contextmanager
def rude_program() -> Iterator[int]:
    """A port held by a program that is not Zenoh and hangs up on every caller."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()

        def hang_up() -> None:
            while True:
                try:
                    caller, _ = server.accept()
                except OSError:
                    return
                caller.close()

        thread = threading.Thread(target=hang_up, daemon=True)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


def one_line(error: BaseException) -> str:
    """What the user reads."""
    text = str(error)
    assert text
    assert "\n" not in text
    return text


def test_a_rendezvous_held_by_another_program_is_reported_in_one_line() -> None:
    with Gathering() as gathering, rude_program() as port:
        with pytest.raises(NetworkError) as caught:
            gathering.join(NetworkSettings(rendezvous=f"tcp/127.0.0.1:{port}"))
        text = one_line(caught.value)
        assert f"the rendezvous tcp/127.0.0.1:{port} does not answer as Zenoh" in text
        assert "--set network.rendezvous=" in text


def test_a_listen_endpoint_in_use_is_reported_in_one_line() -> None:
    with Gathering() as gathering, rude_program() as port:
        for rendezvous in ("", gathering.settings.rendezvous):
            with pytest.raises(NetworkError) as caught:
                gathering.join(NetworkSettings(rendezvous=rendezvous, listen=[f"tcp/127.0.0.1:{port}"]))
            text = one_line(caught.value)
            assert f"cannot listen on tcp/127.0.0.1:{port}" in text
            assert "--set network.listen=" in text
            assert ".rs" not in text  # Zenoh's own source locations are of no use to the user
        assert not accepts(gathering.port)  # what failed to join holds nothing


def test_without_a_rendezvous_a_peer_is_found_by_its_endpoint() -> None:
    with Gathering() as gathering:
        place = f"tcp/127.0.0.1:{free_port()}"
        alone = gathering.join(NetworkSettings(rendezvous="", listen=[place]))
        assert not accepts(gathering.port)
        assert list(alone.info.peers_zid()) == []
        caller = gathering.join(NetworkSettings(rendezvous="", connect=[place]))
        receives(Listener(alone, "t/word"), caller, b"found")


def test_messages_bear_no_time_of_zenohs() -> None:
    """A frame carries what the loop needs and no more; a log's times are in attachments."""
    with Gathering() as gathering:
        speaker, listener = gathering.join(gathering.settings), Listener(gathering.join(gathering.settings), "t/word")
        receives(listener, speaker, b"now")
        assert set(listener.stamped) == {False}


@pytest.mark.parametrize("broken", [{"lease_ms": 99}, {"lease_ms": 60_001}, {"listen": "tcp/127.0.0.1:0"}, {"port": 1}])
def test_network_settings_out_of_bounds_are_refused_by_name(broken: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(broken))):
        NetworkSettings.model_validate(broken)


@pytest.mark.parametrize(
    "topic", [topic for topic in TOPICS.values() if topic.carries != "token"], ids=lambda t: t.name
)
def test_what_exceeds_its_topics_limit_is_not_received(topic: Topic) -> None:
    """Neither published nor asked nor answered, while the longest that is allowed is; its publisher is a stranger."""
    key = topics.key(topic.name, "aero", session="s1", role="plant")
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    with Gathering() as gathering:
        member = gathering.join()
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{gathering.port}"]')
        with zenoh.open(config) as stranger:
            received, answered = list[int](), list[int]()
            subscriber = member.declare_subscriber(key, lambda sample: received.append(len(sample.payload.to_bytes())))
            fits, exceeds = bytes(topic.limit), bytes(topic.limit + 1)

            def arrives() -> bool:
                stranger.put(key, exceeds)
                stranger.put(key, fits)
                return bool(received)

            eventually("the one that fits", arrives)
            assert set(received) == {topic.limit}
            subscriber.undeclare()

            def answer(query: zenoh.Query) -> None:
                assert query.payload is not None
                answered.append(len(query.payload.to_bytes()))
                query.reply(key, fits)

            member.declare_queryable(key, answer)
            eventually("an answer", lambda: any(reply.ok for reply in stranger.get(key, payload=fits)))
            assert not list(stranger.get(key, payload=exceeds, timeout=1.0))
            assert set(answered) == {topic.limit}


def test_refreshing_links_leaves_the_network_as_it_was() -> None:
    """A link that Zenoh failed to make cannot be brought about on purpose; that a refresh disturbs nothing can."""
    settings = NetworkSettings(rendezvous=f"tcp/127.0.0.1:{free_port()}")
    with Role("plant", "aero", settings, {}) as plant, Role("recorder", "aero", settings, {}) as recorder:
        eventually("the link", lambda: str(recorder.zenoh.zid()) in map(str, plant.zenoh.info.peers_zid()))
        before = {str(peer) for peer in plant.zenoh.info.peers_zid()}
        recorder.refresh_links()
        eventually("the old peers", lambda: {str(peer) for peer in plant.zenoh.info.peers_zid()} == before)
