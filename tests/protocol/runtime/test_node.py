"""Node on the network: which queries act, at what cost, and whose token counts."""

from __future__ import annotations

import time

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Status
from aeroloop.protocol.messages.operator import MAX_VALUES, Answer, Message, Points, Request, Track
from aeroloop.protocol.runtime.node import AT_ONCE, LONG_S, WAITING, Node
from tests.support.operated_loop import LEVEL as AT_REST
from tests.support.operated_loop import Loop, Query
from tests.support.zenoh_network import Gathering, eventually


def test_only_a_query_that_names_its_verb_acts() -> None:
    """Tools that list a network query `**`: a plant must be neither stopped nor armed by that."""
    done: list[str] = []

    def act(verb: str) -> Answer:
        done.append(verb)
        return Answer(done=True, text=verb)

    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:
        role.serve("arm", Request, lambda _: lambda: act("arm"))
        role.serve("stop", Request, lambda _: lambda: act("stop"))
        session = gathering.join()
        eventually("a link", lambda: any(session.get("aeroloop/aero/description/plant", timeout=1.0)))

        def answers(key: str) -> list[str]:
            got: list[str] = []
            time.sleep(2 / topics.QUERIES_PER_S)  # sooner after the last query, this one is dropped
            session.get(
                key, lambda reply: got.append(str(reply.ok and reply.ok.key_expr)), target=zenoh.QueryTarget.ALL
            )
            eventually("an answer", lambda: not role.take_inbox() and bool(got))
            return got

        assert "aeroloop/aero/description/plant" in answers("**")
        assert done == []
        assert answers("aeroloop/*/stop") == ["aeroloop/aero/stop"]
        assert done == ["stop"]


LONG = Track(reference=Points(times=[float(n) for n in range(MAX_VALUES)], attitudes=[(0.0, 0.0, 0.0)] * MAX_VALUES))


def asked(loop: Loop, topic: str, payload: bytes, key: str = "") -> list[Answer]:
    """Answers to a query, for which the loop has looked at its inbox."""
    query = Query(key or topics.key(topic, "aero"), payload)
    loop.network.queryables[topics.key(topic, "aero")](query)
    loop.role.take_inbox()
    return query.answers


def done() -> Message:
    return Answer(done=True, text="done")


def test_of_requests_that_take_long_to_parse_one_is_parsed_in_ten_seconds() -> None:
    """And short ones meanwhile as ever; garbage counts, as it takes as long."""
    loop, taken = Loop(AT_REST), list[Track]()
    loop.role.serve("track", Track, lambda track: taken.append(track) or done)  # type: ignore[func-returns-value]
    short, garbage = Track(reference=AT_REST), b"[" + b"0," * 2000 + b"0]"
    for pause_s, payload, text in (
        (LONG_S, LONG.encode(), "done"),
        (0, LONG.encode(), "one in 10 s is taken"),
        (0, short.encode(), "done"),
        (LONG_S, garbage, "not a Track"),
        (0, LONG.encode(), "one in 10 s is taken"),
        (LONG_S, LONG.encode(), "done"),
    ):
        loop.clock.advance(pause_s)
        (answer,) = asked(loop, "track", payload)
        assert text in answer.text
    assert taken == [LONG, short, LONG]


def test_a_request_longer_than_its_topics_is_dropped_whatever_its_key_is() -> None:
    """Zenoh's filter applies to keys that a topic's includes: one with more wildcards passes it."""
    loop, prepared = Loop(AT_REST), list[Message]()
    loop.role.serve("stop", Request, lambda request: prepared.append(request) or done)  # type: ignore[func-returns-value]
    for size, answers in ((topics.TOPICS["stop"].request, 1), (topics.TOPICS["stop"].request + 1, 0)):
        assert len(asked(loop, "stop", b"{}".ljust(size), "aeroloop/**/stop")) == answers
        assert len(prepared) == 1


def test_what_waits_for_the_loop_is_bounded_and_so_is_what_it_does_between_two_ticks() -> None:
    loop, acted = Loop(AT_REST), list[int]()

    def act() -> Message:
        acted.append(1)
        return done()

    loop.role.serve("stop", Request, lambda _: act)
    queries = [Query(topics.key("stop", "aero"), b"{}") for _ in range(WAITING + 1)]
    for query in queries:
        loop.network.queryables[topics.key("stop", "aero")](query)
    (refusal,) = queries[-1].answers
    assert refusal == Answer(done=False, text=f"{WAITING} requests wait already; ask again")
    assert loop.role.take_inbox()
    assert len(acted) == AT_ONCE
    while loop.role.take_inbox():
        pass
    assert len(acted) == WAITING


def test_a_token_of_another_name_and_one_that_another_holds_too_change_nothing() -> None:
    """Zenoh merges tokens of one name, so a second one neither appears nor disappears."""
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:
        seen, marks = list[bool](), list[bool]()
        role.watch_token("controller", seen.append)
        role.watch_token("mark", marks.append)
        controller, stranger = gathering.join(), gathering.join()
        genuine = controller.liveliness().declare_token("aeroloop/aero/alive/controller")
        eventually("it appears", lambda: seen == [True])

        linked = stranger.liveliness().declare_token("aeroloop/aero/alive/mark")  # what ends before it is not seen
        eventually("a token of the stranger", lambda: marks == [True])
        linked.undeclare()
        eventually("its end", lambda: marks == [True, False])
        marks.clear()
        for n, name in enumerate(("controller", "controller-2", "plant", "**"), start=1):
            stranger.liveliness().declare_token(f"aeroloop/aero/alive/{name}").undeclare()
            stranger.liveliness().declare_token("aeroloop/aero/alive/mark").undeclare()  # after it, by the same link
            eventually("the mark and its end", lambda n=n: len(marks) == 2 * n)  # type: ignore[misc]  # bound now
        assert seen == [True]
        genuine.undeclare()
        eventually("it disappears", lambda: seen == [True, False])


def test_a_description_names_the_process_as_its_statuses_do() -> None:
    """So that a reader knows which of several controllers described itself."""
    loop = Loop(AT_REST)
    loop.role.status(Status(role="controller", state="running", uptime_s=0, ticks=0, rate_hz=0, skipped=0))
    (description,), (status,) = loop.published("description", Description), loop.published("status", Status)
    assert description.facts["process"] == status.process != ""
