"""Two Zenoh sessions and a TLS link between them: a guard with access rules, and a hand that tries everything."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh
from zenoh.handlers import Callback, FifoChannel, RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import Action
from tests.support.zenoh_network import PATIENCE_S, eventually, free_port

MARKER: Final = "marker"
"""A key on which anybody may do anything: a link keeps order, so what precedes it has arrived or never will."""
MESSAGES: Final = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)  # every kind that Zenoh's rules tell apart
_BY: Final = zenoh.Locality.REMOTE


def tls(certificate: Path) -> dict[str, Any]:
    own, key = str(certificate), str(certificate.with_suffix(".key"))
    return {
        "root_ca_certificate": str(certificate.with_name("ca.pem")),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        **{f"{way}_certificate": own for way in ("listen", "connect")},
        **{f"{way}_private_key": key for way in ("listen", "connect")},
    }


def open_session(
    certificate: Path,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    access: dict[str, Any] | None = None,
    mode: str = "peer",
) -> zenoh.Session:
    tree = {
        "mode": mode,
        "listen": {"endpoints": list(listen)},
        "connect": {"endpoints": list(connect), "retry": {"period_init_ms": 20, "period_max_ms": 100}},
        "open": {"return_conditions": {"connect_scouted": False}},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": tls(certificate)}, "shared_memory": {"enabled": False}},
        **({"access_control": access} if access else {}),
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(tree)))


def with_marker(access: dict[str, Any], *, egress_open: bool = False) -> dict[str, Any]:
    """Access rules by which anybody may use the marker; and is sent everything, if the other half is to be alone."""
    rights = {"messages": MESSAGES, "permission": "allow"}
    more = [{"id": MARKER, "flows": ["ingress", "egress"], "key_exprs": [MARKER], **rights}]
    if egress_open:
        more.append({"id": "sent", "flows": ["egress"], "key_exprs": ["**", topics.cache_key("**")], **rights})
    return access | {
        "rules": [*access["rules"], *more],
        "subjects": [*access["subjects"], {"id": "anyone"}],
        "policies": [*access["policies"], {"rules": [rule["id"] for rule in more], "subjects": ["anyone"]}],
    }


class Pair(NamedTuple):
    guard: zenoh.Session
    hand: zenoh.Session

    def settle(self) -> None:
        for asking in (self.hand, self.guard):
            assert any(reply.ok for reply in asking.get(MARKER, timeout=PATIENCE_S, allowed_destination=_BY))


@contextmanager
def linked(
    guard: Path, access: dict[str, Any], hand: Path, *, listening: bool = True, protocol: str = "tls"
) -> Iterator[Pair]:
    """A guard with a certificate and rules that listens (or connects to the hand), and a hand with a certificate."""
    place = [f"{protocol}/127.0.0.1:{free_port()}"]
    if listening:
        one = open_session(guard, listen=place, access=access)
        pair = Pair(one, open_session(hand, connect=place))
    else:
        other = open_session(hand, listen=place)
        pair = Pair(open_session(guard, connect=place, access=access), other)
    try:
        for each in pair:
            each.declare_queryable(MARKER, _echo(MARKER, b""))
        for each in pair:
            eventually(
                "a link",
                lambda e=each: any(reply.ok for reply in e.get(MARKER, allowed_destination=_BY)),  # type: ignore[misc]  # bound now
            )
        yield pair
    finally:
        pair.hand.close()
        pair.guard.close()


def attempt(pair: Pair, keys: Sequence[str]) -> dict[Action | str, set[str]]:
    """What a hand achieves at its guard, by action: the keys on which it did."""
    guard, hand = pair
    achieved: dict[Action | str, set[str]] = {}

    at_guard = {key: guard.declare_subscriber(key, RingChannel(4), allowed_origin=_BY) for key in keys}
    pair.settle()
    for key in keys:
        hand.put(key, b"hand", allowed_destination=_BY)
    pair.settle()
    achieved["publish"] = {key for key, subscriber in at_guard.items() if subscriber.try_recv()}
    for key in keys:
        hand.delete(key, allowed_destination=_BY)
    pair.settle()
    achieved["delete"] = {key for key, subscriber in at_guard.items() if subscriber.try_recv()}

    at_hand = {key: hand.declare_subscriber(key, RingChannel(4), allowed_origin=_BY) for key in keys}
    pair.settle()
    for key in keys:
        guard.put(key, b"guard", allowed_destination=_BY)
    pair.settle()
    achieved["subscribe"] = {key for key, subscriber in at_hand.items() if subscriber.try_recv()}

    for action, answering, asking in (("query", guard, hand), ("answer", hand, guard)):
        queryables = [answering.declare_queryable(key, _echo(key, b"")) for key in keys]
        pair.settle()
        replies = {key: asking.get(key, FifoChannel(1024), timeout=PATIENCE_S, allowed_destination=_BY) for key in keys}
        pair.settle()
        achieved[action] = {key for key, channel in replies.items() if _answered(channel)}
        for queryable in queryables:
            queryable.undeclare()

    for action, holding, watching in (("hold", hand, guard), ("watch", guard, hand)):
        tokens = [holding.liveliness().declare_token(key) for key in keys]
        pair.settle()
        asked = {key: watching.liveliness().get(key, FifoChannel(1024), timeout=PATIENCE_S) for key in keys}
        seen = {key: watching.liveliness().declare_subscriber(key, RingChannel(4), history=True) for key in keys}
        pair.settle()
        achieved[action] = {key for key in keys if _answered(asked[key]) or seen[key].try_recv()}
        for token in tokens:
            token.undeclare()
        for subscriber in seen.values():
            subscriber.undeclare()
        pair.settle()
    return achieved


def _answered(channel: Any) -> bool:
    try:
        return (reply := channel.try_recv()) is not None and reply.ok is not None
    except zenoh.ZError:  # ended without a reply
        return False


def _echo(key: str, payload: bytes) -> Callback[zenoh.Query]:
    def answer(query: zenoh.Query) -> None:
        query.reply(key, payload)
        query.drop()

    return Callback(answer, indirect=False)
