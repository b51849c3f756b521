"""Operator commands: status of every role on the network, arm, stop, release, gains and reference.

Each is a Zenoh query that the addressed role answers. Status is answered by the role's network thread from the last
published one, so it never stalls a loop; the other commands are taken between two ticks. A process that hangs or that
is no role delays none of them, and is named by its address and, on this host, by its role and process id.
"""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections.abc import Container, Iterable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

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

Statuses = dict[str, dict[str, Status]]


class OperatorError(AeroloopError):
    """No role answered, or the command was refused; one line."""


class Gathered(NamedTuple):
    """What is on the network.

    Attributes:
        statuses: By vehicle and role. Of several controllers of one vehicle, the one with the session, if any.
        silent: A line about each process that accepts a connection and does not answer.
    """

    statuses: Statuses
    silent: list[str]


def gather(network: NetworkSettings) -> Gathered:
    """Status of every role of every vehicle on the network.

    Raises:
        OperatorError: No role answers.
    """
    statuses: Statuses = {}

    def received(reply: zenoh.Reply) -> None:
        address = topics.read_key(str(reply.ok.key_expr)) if reply.ok is not None else None
        if reply.ok is None or address is None or address.role is None:
            return
        with suppress(ValidationError):  # of another version
            status = Status.model_validate_json(reply.ok.payload.to_bytes())
            roles = statuses.setdefault(address.vehicle, {})
            if address.role not in roles or status.session:
                roles[address.role] = status

    with command_session(network) as here:
        here.wait_for_links()
        for reply in _get(here.session, topics.key("status", "*"), b"", COMMAND_S):
            received(reply)
        silent = _unanswered(here)
    if not statuses:
        raise OperatorError("; ".join([_nobody(network), *silent]))
    return Gathered(statuses, silent)


def only_vehicle(network: NetworkSettings) -> str | None:
    """The one vehicle on the network that has a controller or a plant; None if there is none.

    Raises:
        OperatorError: There are several.
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

    `arm` also recalls controllers that are holding or faulted.

    Returns:
        What was done, in one line.

    Raises:
        OperatorError: No role answers, or it refuses.
    """
    with command_session(network, ANSWER_S, Identity(topics.TOPICS[topic].senders, vehicle)) as here:
        answers: list[Answer] = []
        deadline = time.monotonic() + ANSWER_S
        while not answers and time.monotonic() < deadline:
            answers = _answers(here, topic, vehicle, message)
            time.sleep(POLL_S)
        if not answers:
            role = {"arm": "plant", "mark": "plant", "inject": "emulator"}.get(topic, "controller")
            raise OperatorError("; ".join([_nobody(network, f"no {role} of {vehicle}"), *_unanswered(here)]))
        done = [answer.text for answer in answers if answer.done]  # of several, one success is enough
        if not done:
            raise OperatorError("; ".join(answer.text for answer in answers))
        if topic == "arm":
            done += [answer.text for answer in _answers(here, "recall", vehicle, Request()) if answer.done]
        return "; ".join(done)


class Stopped(NamedTuple):
    """Outcome of a stop.

    Attributes:
        answers: What each plant answered.
        failures: A line about each plant, or process that may be one, which did not.
    """

    answers: list[str]
    failures: list[str]


def stop(network: NetworkSettings, vehicle: str | None = None) -> Stopped:
    """Stop a vehicle's plant, or every plant on the network. What fails at first is tried once more, for longer.

    A process that does not answer is no failure where it is known to be no plant.
    """
    outcome = _stop(network, vehicle or "*", COMMAND_S)
    return _stop(network, vehicle or "*", 4 * COMMAND_S) if outcome.failures else outcome


def _stop(network: NetworkSettings, vehicle: str, wait_s: float) -> Stopped:
    answers: dict[str, list[str]] = {}

    def received(reply: zenoh.Reply) -> None:
        address = topics.read_key(str(reply.ok.key_expr)) if reply.ok is not None else None
        if reply.ok is not None and address is not None:
            answers[address.vehicle].append(Answer.model_validate_json(reply.ok.payload.to_bytes()).text)

    with command_session(
        network, wait_s, Identity(topics.TOPICS["stop"].senders, None if vehicle == "*" else vehicle)
    ) as here:
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < wait_s:
            # A plant declares its token last, so one with a token answers.
            for token in _get(here.session, topics.key("alive", vehicle, role="plant"), None, COMMAND_S):
                address = topics.read_key(str(token.ok.key_expr)) if token.ok is not None else None
                if address is not None and address.vehicle not in answers:
                    answers[address.vehicle] = []
                    here.session.get(
                        topics.key("stop", address.vehicle),
                        received,
                        payload=Request().encode(),
                        attachment=_user(here.certificate),
                        timeout=wait_s,
                        target=zenoh.QueryTarget.ALL,
                        consolidation=zenoh.ConsolidationMode.NONE,
                    )
            if passed > DECLARED_S and not here.unanswered() and all(answers.values()):
                break
            time.sleep(POLL_S)
        unanswered = _unanswered(here, but=("controller", "recorder", "router"), why=wait_s > COMMAND_S)
        alone = _without_plant(here.session, answers) if network.mode == "client" and vehicle == "*" else []
    failures = [f"the plant of {name} does not answer" for name, texts in answers.items() if not texts]
    failures += [f"{name} has a controller, and no plant of it answers" for name in alone]
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


def _without_plant(session: zenoh.Session, answered: Container[str]) -> list[str]:
    """Vehicles that have a controller and did not answer: a router has forgotten a plant that hangs."""
    tokens = _get(session, topics.key("alive", "*"), None, COMMAND_S)
    found = [topics.read_key(str(token.ok.key_expr)) for token in tokens if token.ok is not None]
    controlled = {each.vehicle for each in found if each and each.role and each.role.startswith("controller")}
    return sorted(name for name in controlled if name not in answered)


def _get(
    session: zenoh.Session, key: str, payload: bytes | None, timeout_s: float, attachment: str | None = None
) -> Iterable[zenoh.Reply]:
    """All replies to a query; those of several roles to one key are not merged. A token's key if `payload` is None."""
    if payload is None:
        return session.liveliness().get(key, timeout=timeout_s)
    return session.get(
        key,
        payload=payload,
        attachment=attachment,
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )


def _answers(here: CommandSession, topic: str, vehicle: str, message: Message) -> list[Answer]:
    key, asker = topics.key(topic, vehicle), _user(here.certificate)
    replies = _get(here.session, key, message.encode(), ANSWER_S, asker)
    return [Answer.model_validate_json(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


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
