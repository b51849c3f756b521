"""Operator commands: status of every role on the network, arm, stop, release, gains and reference.

Each is a Zenoh query that the addressed role answers: status by its network thread, the others between two ticks. A
process that hangs or is no role delays none of them, and is named by its address and, on this host, role and pid.
"""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.operator import Answer, Message, Request
from aeroloop.protocol.runtime.host import listener
from aeroloop.protocol.runtime.node import ASKER_LENGTH
from aeroloop.protocol.transport.certificate import Certificate
from aeroloop.protocol.transport.network import COMMAND_S, DECLARED_S, POLL_S, CommandSession, command_session, refusal
from aeroloop.protocol.transport.network_settings import Endpoint, Identity, NetworkSettings

ANSWER_S: Final = 1.0


class OperatorError(AeroloopError):
    """No role answered, or the command was refused; one line."""


class Gathered(NamedTuple):
    """Statuses by vehicle and role, and a line about each process that accepts a connection and does not answer.

    Of several controllers of one vehicle, the status of the one with the session, if any.
    """

    statuses: dict[str, dict[str, Status]]
    silent: list[str]


def gather(network: NetworkSettings) -> Gathered:
    """Status of every role of every vehicle on the network. Raises OperatorError if no role answers."""
    statuses: dict[str, dict[str, Status]] = {}
    with command_session(network) as here:
        here.wait_for_links()
        for address, content in _replies(here.session, topics.key("status", "*"), b"", COMMAND_S):
            with suppress(ValidationError):  # of another version
                status, roles = Status.model_validate_json(content), statuses.setdefault(address.vehicle, {})
                if address.role is not None and (address.role not in roles or status.session):
                    roles[address.role] = status
        silent = _unanswered(here)
    if not any(statuses.values()):
        raise OperatorError("; ".join([_nobody(network), *silent]))
    return Gathered(statuses, silent)


def only_vehicle(network: NetworkSettings) -> str | None:
    """The one vehicle on the network that has a controller or a plant; None if there is none.

    Raises OperatorError if there are several.
    """
    try:
        found = gather(network).statuses
    except OperatorError:  # what is asked of a vehicle says so, too, after a while
        return None
    vehicles = sorted(name for name, roles in found.items() if "plant" in roles or "controller" in roles)
    if len(vehicles) > 1:
        raise OperatorError(f"there are {', '.join(vehicles)}: name one, such as --set vehicle={vehicles[0]}")
    return vehicles[0] if vehicles else None


def send(network: NetworkSettings, vehicle: str, topic: str, message: Message) -> str:
    """Send a request to a vehicle's plant (`arm`, `mark`, `inject`) or controller (`stand_down`, `set_gains`, `track`).

    `arm` also recalls controllers that are holding or faulted. Returns what was done, in one line.

    Raises:
        OperatorError: No role answers, or it refuses.
    """
    with command_session(network, ANSWER_S, Identity(topics.TOPICS[topic].senders, vehicle)) as here:
        return send_by(here, network, vehicle, topic, message)


def send_by(here: CommandSession, network: NetworkSettings, vehicle: str, topic: str, message: Message) -> str:
    """As `send`, by a session that is open."""

    def ask(topic: str, message: Message) -> list[Answer]:
        key, asker = topics.key(topic, vehicle), _user(here.certificate)
        replies = _replies(here.session, key, message.encode(), ANSWER_S, asker)
        return [Answer.model_validate_json(content) for _, content in replies]

    answers: list[Answer] = []
    deadline = time.monotonic() + ANSWER_S
    while not answers and time.monotonic() < deadline:
        answers = ask(topic, message)
        time.sleep(POLL_S)
    if not answers:
        role = {"arm": "plant", "mark": "plant", "inject": "emulator"}.get(topic, "controller")
        raise OperatorError("; ".join([_nobody(network, f"no {role} of {vehicle}"), *_unanswered(here)]))
    done = [answer.text for answer in answers if answer.done]  # of several, one success is enough
    if not done:
        raise OperatorError("; ".join(answer.text for answer in answers))
    if topic == "arm":
        done += [answer.text for answer in ask("recall", Request()) if answer.done]
    return "; ".join(done)


class Stopped(NamedTuple):
    """What each plant answered, and a line about each plant, or process that may be one, which did not."""

    answers: list[str]
    failures: list[str]


def stop(network: NetworkSettings, vehicle: str | None = None) -> Stopped:
    """Stop a vehicle's plant, or every plant on the network. What fails at first is tried once more, for longer.

    A process that does not answer is no failure where it is known to be no plant.
    """
    outcome = _stop(network, vehicle or "*", COMMAND_S)
    return _stop(network, vehicle or "*", 4 * COMMAND_S) if outcome.failures else outcome


def _stop(network: NetworkSettings, vehicle: str, wait_s: float) -> Stopped:
    identity = Identity(topics.TOPICS["stop"].senders, None if vehicle == "*" else vehicle)
    with command_session(network, wait_s, identity) as here:
        return stop_by(here, network, vehicle, wait_s)


def stop_by(
    here: CommandSession, network: NetworkSettings, vehicle: str, wait_s: float = COMMAND_S, known: Iterable[str] = ()
) -> Stopped:
    """Stop a vehicle's plant, or every plant (`*`), by a session that is open, waiting so long for their answers.

    Plants that are `known` are asked before any other is looked for.
    """
    answers: dict[str, list[str]] = {}

    def received(reply: zenoh.Reply) -> None:
        for address, content in _good([reply]):
            answers[address.vehicle].append(Answer.model_validate_json(content).text)

    def ask(name: str) -> None:
        if name not in answers:
            answers[name] = []
            payload, asker = Request().encode(), _user(here.certificate)
            here.session.get(
                topics.key("stop", name), received, payload=payload, attachment=asker, timeout=wait_s, **_ALL
            )

    for name in known:
        ask(name)
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < wait_s:
        # A plant declares its token last, so one with a token answers.
        for address in _alive(here.session, vehicle, role="plant"):
            ask(address.vehicle)
        if passed > DECLARED_S and not here.unanswered() and all(answers.values()):
            break
        time.sleep(POLL_S)
    unanswered = _unanswered(here, but=("controller", "recorder", "router"), why=wait_s > COMMAND_S)
    alone = set[str]()
    if network.mode == "client" and vehicle == "*":  # a router has forgotten a plant that hangs
        controlled = {each.vehicle for each in _alive(here.session, "*") if (each.role or "").startswith("controller")}
        alone = controlled - {*answers}
    failures = [f"the plant of {name} does not answer" for name, texts in answers.items() if not texts]
    failures += [f"{name} has a controller, and no plant of it answers" for name in sorted(alone)]
    failures += unanswered
    if not answers and not failures:
        failures.append(_nobody(network, "no plant" if vehicle == "*" else f"no plant of {vehicle}"))
    return Stopped([text for texts in answers.values() for text in texts], failures)


def _user(certificate: Certificate | None) -> str:
    """This user and host, and the name in the certificate, for people to read."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user without a name
        user = f"uid {os.getuid()}"
    name = f"{user}@{socket.gethostname()}" + (f", certificate of {certificate.name}" if certificate else "")
    return "".join(filter(str.isprintable, name))[:ASKER_LENGTH]


_ALL: Final[Any] = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
"""Of a query: replies of several roles to one key are not merged."""


def _replies(
    session: zenoh.Session, key: str, payload: bytes, timeout_s: float, attachment: str | None = None
) -> Iterator[tuple[topics.Address, bytes]]:
    return _good(session.get(key, payload=payload, attachment=attachment, timeout=timeout_s, **_ALL))


def _alive(session: zenoh.Session, vehicle: str, **role: str) -> Iterator[topics.Address]:
    """Addresses of the roles that have declared their liveliness token."""
    for address, _ in _good(session.liveliness().get(topics.key("alive", vehicle, **role), timeout=COMMAND_S)):
        yield address


def _good(replies: Iterable[zenoh.Reply]) -> Iterator[tuple[topics.Address, bytes]]:
    """topics.Address and content of each reply that is no error."""
    for reply in replies:
        if reply.ok is not None and (address := topics.read_key(str(reply.ok.key_expr))) is not None:
            yield address, reply.ok.payload.to_bytes()


def _unanswered(here: CommandSession, but: Sequence[str] = (), *, why: bool = True) -> list[str]:
    """A line about each process that accepts connections and does not answer; not of some roles of this host.

    `why`: also find out whether certificates are the reason, which takes a while.
    """
    lines = []
    for place in here.unanswered():
        process = listener(place) if Endpoint.parse(place).is_own else None
        if process is None or process.role not in but:
            name = f"the {process}" if process else "the process"
            refused = refusal(place, here.certificate) if why and here.certificate else None
            lines.append(refused or f"{name} at {place} does not answer")
    return lines


def _nobody(network: NetworkSettings, subject: str = "no role") -> str:
    where = ", ".join([*network.rendezvous, *network.connect])
    return f"{subject} answers at {where}; is an emulator or a controller running?"
