"""Role on the network: which queries act."""

from __future__ import annotations

import zenoh

from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.runtime.role import Role
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
