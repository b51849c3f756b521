"""Operator's queries to doubles of roles: a stop waits, tries again, and names who did not answer; other verbs, too."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.runtime.host import name_process
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.network import COMMAND_S, command_session, join
from aeroloop.protocol.transport.network_settings import Endpoint, Identity, NetworkSettings, SecuritySettings
from aeroloop.service.config import Settings
from aeroloop.service.daemon.daemon import Daemon
from aeroloop.service.host import operator
from aeroloop.service.host.operator import OperatorError, gather, send, stop, stop_by
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.zenoh_network import PATIENCE_S, Gathering

Reply = Callable[[], None]


def at_rest(vehicle: str) -> str:
    return f"{vehicle} is at 0 V"


class Plant:
    """A double of a vehicle's plant, with a token. `answer` is called with each stop's way to reply."""

    def __init__(self, session: zenoh.Session, vehicle: str, answer: Callable[[Reply], None]) -> None:
        self.asked = 0
        self._session = session
        self._answer = answer
        self._key = topics.key("stop", vehicle)
        self._text = at_rest(vehicle)
        self._session.declare_queryable(self._key, self._received, complete=True)
        self._token = self._session.liveliness().declare_token(topics.key("alive", vehicle, role="plant"))
        self._queries: list[zenoh.Query] = []

    def _received(self, query: zenoh.Query) -> None:
        self.asked += 1
        self._queries.append(query)  # until it is dropped, nobody knows that no answer will come

        def reply() -> None:
            query.reply(self._key, Answer(done=True, text=self._text).encode())
            query.drop()

        self._answer(reply)


def never(_: Reply) -> None:
    """Answer nothing."""


def promptly(reply: Reply) -> None:
    reply()


def test_a_stop_waits_for_a_slow_plant_after_another_has_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """One try, which may last long: the slow one answers once the operator has read the prompt one's answer."""
    monkeypatch.setattr(operator, "COMMAND_S", PATIENCE_S)
    told: list[str] = []
    has_told = threading.Event()

    def on_answer(text: str) -> None:
        told.append(text)
        has_told.set()

    def slowly(reply: Reply) -> None:
        def reply_when_told() -> None:
            has_told.wait(PATIENCE_S)
            reply()

        threading.Thread(target=reply_when_told).start()

    with Gathering() as gathering:
        Plant(gathering.join(), "prompt", promptly)
        Plant(gathering.join(), "slow", slowly)
        stopped = stop(gathering.settings, patience_s=0, on_answer=on_answer)
    assert told == [at_rest("prompt"), at_rest("slow")]
    assert stopped == (told, [])


def test_a_stop_tries_again_and_asks_only_the_plant_that_has_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator, "AGAIN_S", COMMAND_S)

    with Gathering() as gathering:

        def answers_when_asked_again(reply: Reply) -> None:
            if hesitant.asked > 1:
                reply()

        prompt = Plant(gathering.join(), "prompt", promptly)
        hesitant = Plant(gathering.join(), "hesitant", answers_when_asked_again)
        stopped = stop(gathering.settings, patience_s=PATIENCE_S)
        assert hesitant.asked == 2
        assert prompt.asked == 1
    assert sorted(stopped.answers) == [at_rest("hesitant"), at_rest("prompt")]
    assert stopped.failures == []


def test_a_plant_that_never_answers_is_named_and_the_others_answers_are_given() -> None:
    """After `COMMAND_S`, in which a plant is seen within milliseconds; a busy machine has the second try."""
    with Gathering() as gathering:
        Plant(gathering.join(), "prompt", promptly)
        Plant(gathering.join(), "mute", never)
        stopped = stop(gathering.settings, patience_s=2 * COMMAND_S)
    assert stopped.answers == [at_rest("prompt")]
    assert stopped.failures == ["the plant of mute does not answer: what was asked may still act"]


def test_a_stop_of_one_vehicle_waits_for_no_other() -> None:
    with Gathering() as gathering:
        Plant(gathering.join(), "prompt", promptly)
        mute = Plant(gathering.join(), "mute", never)
        assert stop(gathering.settings, "prompt") == ([at_rest("prompt")], [])
        assert mute.asked == 0


def test_an_answer_that_arrives_twice_is_told_once() -> None:
    """As by two carriers."""
    told: list[str] = []
    key = topics.key("stop", "aero")

    def answer(query: zenoh.Query) -> None:
        for _ in range(2):
            query.reply(key, Answer(done=True, text=at_rest("aero")).encode())

    with Gathering() as gathering:
        session = gathering.join()
        session.declare_queryable(key, answer, complete=True)
        token = session.liveliness().declare_token(topics.key("alive", "aero", role="plant"))
        assert stop(gathering.settings, on_answer=told.append) == ([at_rest("aero")], [])
        token.undeclare()
    assert told == [at_rest("aero")]


@pytest.fixture
def secured(tmp_path: Path) -> NetworkSettings:
    """A network with certificates, of two vehicles."""
    authority = Authority(tmp_path)
    for role, vehicle in (("plant", "aero"), ("plant", "bero"), ("operator", None)):
        authority.issue(role, vehicle)
    security = SecuritySettings(directory=str(tmp_path), vehicles=["aero", "bero"])
    return NetworkSettings(rendezvous=[free_rendezvous("tls")], security=security)


def test_with_certificates_a_stop_is_done_once_the_plant_of_every_vehicle_has_answered(
    secured: NetworkSettings,
) -> None:
    """Whatever else accepts connections and does not answer: it is no plant of a vehicle that has rights here."""
    aero_is_told = threading.Event()

    def when_aero_is_told(reply: Reply) -> None:
        if aero_is_told.is_set():  # else it is asked again
            reply()

    with ExitStack() as stack:
        aero = stack.enter_context(closing(join(secured, Identity(("plant",), "aero"))))
        bero = stack.enter_context(closing(join(secured, Identity(("plant",), "bero"))))
        place = Endpoint.parse(secured.rendezvous_endpoints[-1])
        stack.enter_context(socket.create_server(place.address))
        Plant(aero, "aero", promptly)
        Plant(bero, "bero", when_aero_is_told)
        stopped = stop(secured, patience_s=PATIENCE_S, on_answer=lambda _: aero_is_told.set())
    assert stopped == ([at_rest("aero"), at_rest("bero")], [])


def test_with_certificates_what_may_be_the_plant_of_a_vehicle_that_has_not_answered_is_named(
    secured: NetworkSettings,
) -> None:
    name_process("plant")  # another test in this process may have run a role that is known to be no plant
    places = [Endpoint.parse(text) for text in secured.rendezvous_endpoints]
    with closing(join(secured, Identity(("plant",), "aero"))) as session, socket.create_server(places[-1].address):
        Plant(session, "aero", promptly)
        stopped = stop(secured, patience_s=2 * COMMAND_S)
    assert stopped.answers == [at_rest("aero")]
    (failure,) = stopped.failures
    assert str(places[-1]) in failure


def test_a_stop_that_a_plant_refuses_is_a_failure() -> None:
    """As one does with 64 requests waiting."""
    refused = Answer(done=False, text="64 requests wait already; ask again")
    key = topics.key("stop", "aero")
    with Gathering() as gathering:
        session = gathering.join()
        session.declare_queryable(key, lambda query: query.reply(key, refused.encode()), complete=True)
        token = session.liveliness().declare_token(topics.key("alive", "aero", role="plant"))
        stopped = stop(gathering.settings, patience_s=2 * COMMAND_S)
        token.undeclare()
    assert stopped == ([], [refused.text])


def test_where_every_port_refuses_connections_a_stop_tries_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[float] = []

    def counted(network: NetworkSettings, wait_s: float, *identity: Identity, by_datagrams: bool) -> Any:
        tries.append(wait_s)
        return command_session(network, wait_s, *identity, by_datagrams=by_datagrams)

    monkeypatch.setattr(operator, "command_session", counted)
    with Gathering() as gathering:
        stopped = stop(gathering.settings, patience_s=4 * COMMAND_S)
    assert stopped.answers == []
    assert "no plant answers" in stopped.failures[0]
    assert tries == [COMMAND_S]


def test_a_console_s_session_asks_each_known_plant_at_once() -> None:
    with Gathering() as gathering:
        plant = Plant(gathering.join(), "aero", promptly)
        with command_session(gathering.settings) as here:
            here.wait_for_links()
            assert stop_by(here, gathering.settings, "aero", known=["aero"]) == ([at_rest("aero")], [])
        assert plant.asked == 1


# ── a controller passes a stop on ──


@contextmanager
def controller(network: NetworkSettings) -> Iterator[None]:
    """A controller's daemon, which finds no plant to claim."""
    with Node("controller", "aero", network, {}, name="controller-1") as role:
        daemon = Daemon(role, Settings())
        thread = threading.Thread(target=daemon.run)
        thread.start()
        try:
            yield
        finally:
            role.stop.set()
            thread.join()


def test_a_stop_goes_through_the_controller_where_no_plant_is_seen() -> None:
    """The plant has no token and answers no `stop` here, as where no new link reaches it. Once, with who asked."""
    received: list[str] = []
    key = topics.key("forwarded_stop", "aero")

    def answer(query: zenoh.Query) -> None:
        received.append(query.attachment.to_bytes().decode() if query.attachment else "")
        query.reply(key, Answer(done=True, text=at_rest("aero")).encode())

    with Gathering() as gathering, controller(gathering.settings):
        plant = gathering.join()
        plant.declare_queryable(key, answer, complete=True)
        stopped = stop(gathering.settings, "aero", patience_s=PATIENCE_S)
        plant.close()
    assert stopped == ([at_rest("aero")], [])
    assert len(received) == 1
    assert "@" in received[0]


def test_a_controller_without_a_plant_to_pass_a_stop_on_to_says_so() -> None:
    with Gathering() as gathering, controller(gathering.settings):
        stopped = stop(gathering.settings, "aero", patience_s=2 * COMMAND_S)
        assert stopped.answers == []
        assert "no plant of aero answers at" in stopped.failures[0]


# ── other verbs, and newer versions ──


def test_a_verb_that_no_role_answers_in_time_says_that_it_may_still_act() -> None:
    with Gathering() as gathering:
        session = gathering.join()
        held: list[zenoh.Query] = []
        session.declare_queryable(topics.key("arm", "aero"), held.append, complete=True)
        with pytest.raises(OperatorError, match=r"the plant of aero did not answer within 1 s: .* may still act"):
            send(gathering.settings, "aero", "arm", Request())
        assert len(held) == 1  # it is not asked for twice


def test_a_verb_that_reached_nobody_says_no_such_thing() -> None:
    with Gathering() as gathering:
        gathering.join()
        with pytest.raises(OperatorError, match="no plant of aero answers") as caught:
            send(gathering.settings, "aero", "arm", Request())
    assert "may still act" not in str(caught.value)


@pytest.mark.parametrize("names", [("first", "second"), ("second", "first")])
def test_of_several_controllers_the_status_of_the_one_with_the_session_is_gathered(names: tuple[str, str]) -> None:
    """Whichever is met first: both orders are tried."""
    key = topics.key("status", "aero", role="controller")
    with Gathering() as gathering:
        for name in names:
            session = "s" if name == "first" else None
            status = Status(
                role="controller", state="running", session=session, uptime_s=1, ticks=1, rate_hz=0, skipped=0
            )

            def answer(query: zenoh.Query, content: bytes = status.encode()) -> None:
                query.reply(key, content)

            gathering.join().declare_queryable(key, answer, complete=True)
        for _ in range(3):
            assert gather(gathering.settings).statuses["aero"]["controller"].session == "s"


def with_unknown_field(message: Any) -> bytes:
    return json.dumps({**json.loads(message.encode()), "of_a_newer_version": 1}).encode()


def test_a_status_and_answers_with_a_field_of_a_newer_version_are_read() -> None:
    status = Status(role="plant", state="driven", uptime_s=1, ticks=1, rate_hz=500, skipped=0)
    contents = {
        topics.key("status", "aero", role="plant"): with_unknown_field(status),
        topics.key("arm", "aero"): with_unknown_field(Answer(done=True, text="armed")),
        topics.key("stop", "aero"): with_unknown_field(Answer(done=True, text=at_rest("aero"))),
    }
    with Gathering() as gathering:
        session = gathering.join()
        for key, content in contents.items():

            def answer(query: zenoh.Query, key: str = key, content: bytes = content) -> None:
                query.reply(key, content)

            session.declare_queryable(key, answer, complete=True)
        token = session.liveliness().declare_token(topics.key("alive", "aero", role="plant"))
        assert gather(gathering.settings).statuses["aero"]["plant"].state == "driven"
        assert send(gathering.settings, "aero", "arm", Request()) == "armed"
        assert stop(gathering.settings) == ([at_rest("aero")], [])
        token.undeclare()
