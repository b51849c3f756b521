"""An operator's verbs: look at every role on the network, arm a plant, stop it.

Each is a question over Zenoh, answered by the role it is put to. Status is answered by the role's network thread from
what it last said, so asking never stalls a loop; arm and stop are taken by the plant between two ticks.
"""

from __future__ import annotations

import time
from typing import Final

import zenoh

from protocol import topics
from protocol.errors import AeroloopError
from protocol.messages import Status
from protocol.network import NetworkSettings, join

GATHER_S: Final = 1.0
"""How long to look for roles. Gossip links a newcomer to all of them in some 50 ms."""
ANSWER_S: Final = 1.0

Statuses = dict[str, dict[str, Status]]


class OperatorError(AeroloopError):
    """Nobody answered, or the answer was no; one line."""


def gather(network: NetworkSettings) -> Statuses:
    """Status of every role of every vehicle on the network, by vehicle and role.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: Nobody is there.
    """
    with join(network) as session:
        found: Statuses = {}
        deadline = time.monotonic() + GATHER_S
        while time.monotonic() < deadline:
            for reply in session.get(topics.key("status", "*"), timeout=ANSWER_S):
                if reply.ok is None or (address := topics.read_key(str(reply.ok.key_expr))) is None:
                    continue
                if address.role is not None:
                    status = Status.model_validate_json(reply.ok.payload.to_bytes())
                    found.setdefault(address.vehicle, {})[address.role] = status
            time.sleep(0.1)
    if not found:
        raise OperatorError(f"nobody answers at {network.rendezvous}; is an emulator or a controller running?")
    return found


def arm(network: NetworkSettings, vehicle: str) -> None:
    """Arm a plant, so that the next claim is granted.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: No plant answers, or a controller holds it.
    """
    if not _ask(network, "arm", vehicle):
        raise OperatorError(f"{vehicle} is held by a controller, so there is nothing to arm")


def stop(network: NetworkSettings, vehicle: str) -> None:
    """Stop a plant: 0 V at its next tick, and no claim until it is armed.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: No plant answers.
    """
    _ask(network, "stop", vehicle)


def _ask(network: NetworkSettings, verb: str, vehicle: str) -> bool:
    """Put a question to a plant until it answers; a newcomer's links take a moment."""
    with join(network) as session:
        deadline = time.monotonic() + ANSWER_S
        while time.monotonic() < deadline:
            if (answer := _answer(session, topics.key(verb, vehicle))) is not None:
                return answer == b"true"
            time.sleep(0.02)
    raise OperatorError(f"no plant called {vehicle} answers at {network.rendezvous}")


def _answer(session: zenoh.Session, key: str) -> bytes | None:
    for reply in session.get(key, timeout=ANSWER_S):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
    return None
