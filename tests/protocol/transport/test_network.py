"""Network: any process can be joined at, none is needed by the others, and one that hangs delays nobody."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable

import pytest
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import QUERIES_PER_S, TOPICS, Topic
from aeroloop.protocol.runtime.host import listener, name_process
from aeroloop.protocol.transport.network import command_session
from aeroloop.protocol.transport.network_settings import PORTS, NetworkError, NetworkSettings
from tests.support.zenoh_network import Gathering, accepts, eventually


class Listener:
    """What a session receives on a key."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.received: set[bytes] = set()
        self.stamped: list[bool] = []
        self._subscriber = session.declare_subscriber(key, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        self.stamped.append(sample.timestamp is not None)
        self.received.add(sample.payload.to_bytes())


def receives(listener: Listener, speaker: zenoh.Session, word: bytes, key: str = "t/word") -> None:
    """Publish a word until it is received: the first may go before the subscription is known."""

    def said() -> bool:
        speaker.put(key, word)
        return word in listener.received

    eventually(f"receiving {word!r}", said)


def peers(member: zenoh.Session) -> set[str]:
    return {str(zid) for zid in member.info.peers_zid()}


def linked(members: Iterable[zenoh.Session]) -> None:
    """Wait until each is linked to all others and to no other."""
    everyone = {str(member.zid()) for member in members}
    for member in members:
        eventually("linking", lambda m=member: peers(m) == everyone - {str(m.zid())})  # type: ignore[misc]  # bound now


def test_each_process_listens_at_a_port_of_its_own_and_links_to_all_and_a_command_to_each() -> None:
    """Messages bear no time of Zenoh's: a frame carries what the loop needs, and a log's times are in attachments."""
    with Gathering() as gathering:
        members = []
        for taken in range(4):
            assert [accepts(port) for port in gathering.ports] == [port < taken for port in range(8)]
            members.append(gathering.join())
        linked(members)
        # One link a pair: one from each end would outlast the other's session, after a halt of a process.
        assert [len(list(member.info.links())) for member in members] == [3, 3, 3, 3]
        ear = Listener(members[3], "t/word")
        receives(ear, members[0], b"from the first")
        assert set(ear.stamped) == {False}
        with command_session(gathering.settings) as here:
            linked([*members, here.session])
            assert here.unanswered() == []
            assert [accepts(port) for port in gathering.ports] == [port < 4 for port in range(8)]


@pytest.mark.parametrize("first_to_go", [0, 2])
def test_whichever_process_ends_a_newcomer_links_to_the_rest_and_takes_its_port(first_to_go: int) -> None:
    with Gathering() as gathering:
        members = [gathering.join() for _ in range(3)]
        linked(members)
        members.pop(first_to_go).close()
        eventually("its leaving", lambda: not accepts(gathering.ports[first_to_go]))
        linked(members)
        members.append(gathering.join())
        assert accepts(gathering.ports[first_to_go])
        linked(members)


def test_more_processes_than_ports_link_by_gossip() -> None:
    with Gathering() as gathering:
        linked([gathering.join() for _ in range(PORTS + 2)])


def test_a_process_that_accepts_and_does_not_answer_is_named_and_stops_nobody() -> None:
    """A halted process is such a one: the kernel accepts for it."""
    with Gathering() as gathering, socket.create_server(("127.0.0.1", gathering.ports[0])):
        members = [gathering.join(), gathering.join()]
        linked(members)
        with command_session(gathering.settings) as here:
            linked([*members, here.session])
            assert here.unanswered() == [gathering.settings.rendezvous_endpoints[0]]
        name_process("plant")
        assert listener(gathering.settings.rendezvous_endpoints[0]) == (os.getpid(), "plant")
        name_process("pytest")
        assert listener(gathering.settings.rendezvous_endpoints[0]) == (os.getpid(), None)


def test_a_listen_endpoint_in_use_is_reported_in_one_line() -> None:
    with Gathering() as gathering, socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(NetworkError) as caught:
            gathering.join(NetworkSettings(rendezvous=gathering.settings.rendezvous, listen=[endpoint]))
        (text,) = str(caught.value).splitlines()
        assert f"cannot listen on {endpoint}" in text
        assert "--set network.listen='[\"tcp/127.0.0.1:0\"]'" in text
        assert ".rs" not in text  # Zenoh's own source locations are of no use to the user
        assert not any(accepts(each) for each in gathering.ports)  # what failed to join holds nothing


@pytest.mark.parametrize("topic", [topic for topic in TOPICS.values() if topic.kind != "token"], ids=lambda t: t.name)
def test_what_exceeds_its_topics_limit_is_not_received(topic: Topic) -> None:
    """Neither published nor asked nor answered, while the longest that is allowed is; its publisher is a stranger."""
    key = topics.key(topic.name, "aero", session="s1", role="plant")
    with Gathering() as gathering:
        member = gathering.join()
        with stranger_of(gathering) as stranger:
            received, answered = list[int](), list[int]()
            subscriber = member.declare_subscriber(key, lambda sample: received.append(len(sample.payload.to_bytes())))
            fits, exceeds = bytes(topic.limit), bytes(topic.limit + 1)
            asks, asks_more = bytes(topic.request), bytes(topic.request + 1)

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
            eventually("an answer", lambda: any(reply.ok for reply in stranger.get(key, payload=asks)))
            time.sleep(2 / QUERIES_PER_S)  # a query that comes sooner is dropped whatever its length
            assert not list(stranger.get(key, payload=asks_more, timeout=1.0))
            assert set(answered) == {topic.request}


def stranger_of(gathering: Gathering) -> zenoh.Session:
    """A session with none of this project's settings, linked to the gathering's first process."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{gathering.ports[0]}"]')
    return zenoh.open(config)


@pytest.mark.parametrize("key", ["aeroloop/aero/stop", "aeroloop/*/stop", "aeroloop/**", "**"])
def test_who_queries_too_often_is_answered_at_the_topics_rate_and_keeps_nobody_else_out(key: str) -> None:
    """By link: another one is answered at once while the first floods. A dropped query ends without an answer."""
    with Gathering() as gathering:
        answers = list[float]()

        def answer(query: zenoh.Query) -> None:
            answers.append(time.monotonic())
            query.reply("aeroloop/aero/stop", b"stopped")

        gathering.join().declare_queryable("aeroloop/aero/stop", answer)
        with stranger_of(gathering) as stranger, stranger_of(gathering) as operator:
            eventually("a link", lambda: any(reply.ok for reply in operator.get("aeroloop/aero/stop")))
            eventually("a link", lambda: any(reply.ok for reply in stranger.get("aeroloop/aero/stop")))
            time.sleep(2 / QUERIES_PER_S)  # since their last queries
            answers.clear()
            begun, asked = time.monotonic(), 0
            while len(answers) < 5:
                list(stranger.get(key))
                asked += 1
            assert len(answers) <= 1 + (time.monotonic() - begun) * QUERIES_PER_S * 1.01
            assert asked > len(answers)
            assert any(reply.ok for reply in operator.get("aeroloop/aero/stop"))
