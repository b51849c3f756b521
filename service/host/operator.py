"""Operator commands: status of every role on the network, arm, stop, release, gains and reference.

Each is a Zenoh query that the addressed role answers. Status is answered by the role's network thread from the last
published one, so it never stalls a loop; the other commands are taken between two ticks.
"""

from __future__ import annotations

import time
from typing import Final

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.operator import Answer, Ask, Message
from aeroloop.protocol.transport.network import NetworkSettings, join

GATHER_S: Final = 1.0
"""How long to query for roles [s]. Gossip links a new peer to all others in some 50 ms."""
ANSWER_S: Final = 1.0

Statuses = dict[str, dict[str, Status]]


class OperatorError(AeroloopError):
    """No role answered, or the command was refused; one line."""


def gather(network: NetworkSettings) -> Statuses:
    """Status of every role of every vehicle on the network, by vehicle and role.

    Of several controllers of one vehicle it is the one with the session, if any.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: No role answers.
    """
    with join(network) as session:
        found: Statuses = {}
        deadline = time.monotonic() + GATHER_S
        while time.monotonic() < deadline:
            now: Statuses = {}
            for reply in session.get(topics.key("status", "*"), timeout=ANSWER_S, target=zenoh.QueryTarget.ALL):
                if reply.ok is None or (address := topics.read_key(str(reply.ok.key_expr))) is None:
                    continue
                if address.role is not None:
                    status = Status.model_validate_json(reply.ok.payload.to_bytes())
                    roles = now.setdefault(address.vehicle, {})
                    if address.role not in roles or status.session:
                        roles[address.role] = status
            for vehicle, roles in now.items():
                found.setdefault(vehicle, {}).update(roles)
            time.sleep(0.1)
    if not found:
        raise OperatorError(f"no role answers at {network.rendezvous}; is an emulator or a controller running?")
    return found


def send(network: NetworkSettings, vehicle: str, topic: str, message: Message) -> str:
    """Send a command to a vehicle's plant (`arm`, `stop`) or controller (`stand_down`, `set_gains`, `track`).

    `arm` also recalls controllers that are holding or faulted.

    Returns:
        What was done, in one line.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: No role answers, or it refuses.
    """
    with join(network) as session:
        texts = [_query(session, network, vehicle, topic, message)]
        if topic == "arm":
            texts += [answer.text for answer in _answers(session, "recall", vehicle, Ask()) if answer.done]
        return "; ".join(texts)


def _query(session: zenoh.Session, network: NetworkSettings, vehicle: str, topic: str, message: Message) -> str:
    """Query until a role answers, as a new peer's links take a moment. Of several answers one success is enough."""
    deadline = time.monotonic() + ANSWER_S
    while time.monotonic() < deadline:
        if answers := _answers(session, topic, vehicle, message):
            for answer in answers:
                if answer.done:
                    return answer.text
            raise OperatorError("; ".join(answer.text for answer in answers))
        time.sleep(0.02)
    role = "plant" if topic in ("arm", "stop") else "controller"
    raise OperatorError(f"no {role} of {vehicle} answers at {network.rendezvous}")


def _answers(session: zenoh.Session, topic: str, vehicle: str, message: Message) -> list[Answer]:
    replies = session.get(
        topics.key(topic, vehicle), payload=message.encode(), timeout=ANSWER_S, target=zenoh.QueryTarget.ALL
    )
    return [Answer.model_validate_json(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
