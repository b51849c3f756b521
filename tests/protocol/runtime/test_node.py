"""Node on the network: which queries act, at what cost, and whose token counts."""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import MAX_VALUES, Answer, Message, Points, Request, Track
from aeroloop.protocol.runtime.node import AT_ONCE, LONG_S, WAITING, Node
from tests.support.operated_loop import LEVEL as AT_REST
from tests.support.operated_loop import Loop, Query
from tests.support.zenoh_network import Gathering, eventually


def test_only_a_query_that_names_its_verb_acts() -> None:
    """Tools that list a network query `**`: a plant must be neither stopped nor armed by that."""
    done: list[str] = []
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:

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


def asked(role: Node, loop: Loop, topic: str, payload: bytes) -> Query:
    query = Query(topics.key(topic, "aero"), payload)
    loop.network.queryables[topics.key(topic, "aero")](query)
    role.take_inbox()
    return query


def done() -> Message:
    return Answer(done=True, text="done")


def test_of_requests_that_take_long_to_parse_one_is_parsed_in_ten_seconds() -> None:
    """And short ones meanwhile as ever; garbage counts, as it takes as long."""
    loop, taken = Loop(AT_REST), list[Track]()

    def prepare(track: Track) -> Callable[[], Message]:
        taken.append(track)
        return done

    loop.role.serve("track", Track, prepare)

    def ask(payload: bytes) -> str:
        (answer,) = asked(loop.role, loop, "track", payload).answers
        return answer.text

    loop.clock.advance(LONG_S)
    assert ask(LONG.encode()) == "done"
    assert "one in 10 s is taken" in ask(LONG.encode())
    assert ask(Track(reference=AT_REST).encode()) == "done"
    loop.clock.advance(LONG_S)
    assert "not a Track" in ask(b"[" + b"0," * 2000 + b"0]")
    assert "one in 10 s is taken" in ask(LONG.encode())
    loop.clock.advance(LONG_S)
    assert ask(LONG.encode()) == "done"
    assert taken == [LONG, Track(reference=AT_REST), LONG]


def test_a_request_longer_than_its_topics_is_dropped_whatever_its_key_is() -> None:
    """Zenoh's filter applies to keys that a topic's includes: one with more wildcards passes it."""
    loop, prepared = Loop(AT_REST), list[Message]()
    loop.role.serve("stop", Request, lambda request: prepared.append(request) or done)  # type: ignore[func-returns-value]
    for size, answers in ((topics.TOPICS["stop"].request, 1), (topics.TOPICS["stop"].request + 1, 0)):
        query = Query("aeroloop/**/stop", b"{}".ljust(size))
        loop.network.queryables[topics.key("stop", "aero")](query)
        loop.role.take_inbox()
        assert (len(query.answers), len(prepared)) == (answers, 1)


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
        seen = list[bool]()
        role.watch_token("controller", seen.append)
        marks = list[bool]()
        role.watch_token("mark", marks.append)
        controller, stranger = gathering.join(), gathering.join()
        genuine = controller.liveliness().declare_token("aeroloop/aero/alive/controller")
        eventually("it appears", lambda: seen == [True])

        def forge(name: str) -> None:
            token = stranger.liveliness().declare_token(f"aeroloop/aero/alive/{name}")
            token.undeclare()
            mark = stranger.liveliness().declare_token("aeroloop/aero/alive/mark")  # after it, by the same link
            eventually("the mark", lambda: bool(marks) and marks[-1])
            mark.undeclare()
            eventually("no mark", lambda: not marks[-1])

        for name in ("controller", "controller-2", "plant", "**"):
            forge(name)
        assert seen == [True]
        genuine.undeclare()
        eventually("it disappears", lambda: seen == [True, False])
