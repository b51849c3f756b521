"""Operator commands: status of every role on the network, arm, stop, release, gains and reference.

Each is a Zenoh query that the addressed role answers: status by its network thread, the others between two ticks. A
process that hangs or is no role delays none of them, and is named by its address and, on this host, role and pid.
"""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.operator import Answer, Message, MessageError, Request
from aeroloop.protocol.runtime.host import listener
from aeroloop.protocol.runtime.node import ASKER_LENGTH
from aeroloop.protocol.transport.certificate import Certificate
from aeroloop.protocol.transport.network import (
    COMMAND_S,
    DECLARED_S,
    POLL_S,
    CommandSession,
    NoRouterError,
    command_session,
    refusal,
)
from aeroloop.protocol.transport.network_settings import Endpoint, Identity, NetworkSettings

ANSWER_S: Final = 1.0
STOP_S: Final = 10.0  # how long `stop` tries to reach every plant
AGAIN_S: Final = 4 * COMMAND_S  # the longest try of `stop`; each lasts twice as long as the one before
FORWARD_AFTER_S: Final = 0.25  # how long a plant has to answer a stop before its controller is asked to pass it on
_MAY_ACT: Final = "what was asked may still act"


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
            with suppress(MessageError):
                status = Status.decode(content, extra="ignore")  # a newer version's has fields of its own
                roles = statuses.setdefault(address.vehicle, {})
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
    role = {"arm": "plant", "mark": "plant", "inject": "emulator"}.get(topic, "controller")
    deadline = time.monotonic() + ANSWER_S
    answers, timed_out = _ask(here, vehicle, topic, message)
    while not answers and not timed_out and time.monotonic() < deadline:  # it was asked of nobody: no link yet
        time.sleep(POLL_S)
        answers, timed_out = _ask(here, vehicle, topic, message)
    if not answers and timed_out:
        raise OperatorError(f"the {role} of {vehicle} did not answer within {ANSWER_S:g} s: {_MAY_ACT}")
    if not answers:
        raise OperatorError("; ".join([_nobody(network, f"no {role} of {vehicle}"), *_unanswered(here)]))
    done = [answer.text for answer in answers if answer.done]  # of several, one success is enough
    if not done:
        raise OperatorError("; ".join(answer.text for answer in answers))
    if topic == "arm":
        recalled, timed_out = _ask(here, vehicle, "recall", Request())
        done += [answer.text for answer in recalled if answer.done]
        if timed_out:
            done.append(f"a controller of {vehicle} did not answer within {ANSWER_S:g} s: its recall may still act")
    return "; ".join(done)


def _ask(here: CommandSession, vehicle: str, topic: str, message: Message) -> tuple[list[Answer], bool]:
    """Answers to a request, and whether a role that it was sent to did not answer in time."""
    key, asker = topics.key(topic, vehicle), _user(here.certificate)
    replies = list(here.session.get(key, payload=message.encode(), attachment=asker, timeout=ANSWER_S, **_ALL))
    answers: list[Answer] = []
    for _, content in _good(replies):
        with suppress(MessageError):
            answers.append(Answer.decode(content, extra="ignore"))
    return answers, any(reply.err is not None for reply in replies)


class Stopped(NamedTuple):
    """What each plant answered, and a line about each plant, or process that may be one, which did not."""

    answers: list[str]
    failures: list[str]


def stop(
    network: NetworkSettings,
    vehicle: str | None = None,
    patience_s: float = STOP_S,
    on_answer: Callable[[str], object] = lambda _: None,
) -> Stopped:
    """Stop a vehicle's plant, or every plant on the network. What fails is tried again until `patience_s` has passed.

    Each try has a session of its own, which links by TCP and, where plants take frames by datagrams, by QUIC at once:
    a flood of one carrier's ports does not keep it from the other. `on_answer` is called with each plant's answer
    as it arrives. A process that does not answer is no failure where it is known to be no plant, nor once every plant
    that this process may reach has answered. Raises NetworkError where no router answers a client.
    """
    identity = Identity(topics.TOPICS["stop"].senders, vehicle)
    deadline = time.monotonic() + patience_s
    answers: dict[str, str] = {}
    wait_s = COMMAND_S
    while True:
        is_last = time.monotonic() + wait_s >= deadline
        try:
            with command_session(network, wait_s, identity, by_datagrams=True) as here:
                attempt = _StopAttempt(here, network, vehicle or "*", answers, on_answer)
                failures = attempt.run(wait_s, find_reasons=is_last)
                if is_last or not failures or here.is_deserted:
                    return Stopped([*answers.values()], failures)
        except NoRouterError as error:
            if is_last or error.is_deserted:
                raise
        wait_s = min(2 * wait_s, AGAIN_S)


def stop_by(here: CommandSession, network: NetworkSettings, vehicle: str, known: Iterable[str] = ()) -> Stopped:
    """Stop a vehicle's plant, or every plant (`*`), by a session that is open: one try.

    Plants that are `known` are asked before any other is looked for.
    """
    answers: dict[str, str] = {}
    attempt = _StopAttempt(here, network, vehicle, answers, lambda _: None)
    for name in known:
        attempt.ask(name)
    failures = attempt.run(COMMAND_S, find_reasons=False)
    return Stopped([*answers.values()], failures)


class _StopAttempt:
    """One try to stop a vehicle's plant, or every plant (`*`). Adds to `answers`, by vehicle, and asks no other.

    Zenoh's threads put what plants answer into `_replied` and `_refusals`; all else is the caller's thread's.
    """

    def __init__(
        self,
        here: CommandSession,
        network: NetworkSettings,
        vehicle: str,
        answers: dict[str, str],
        on_answer: Callable[[str], object],
    ) -> None:
        self._here, self._network, self._vehicle = here, network, vehicle
        self._answers = answers
        self._on_answer = on_answer
        self._wanted = here.vehicles if vehicle == "*" else (vehicle,)  # empty: nobody knows them all
        self._asked: set[str] = set()  # vehicles whose plant was asked
        self._forwarded: set[str] = set()  # vehicles whose controller was asked
        self._controlled: set[str] = set()  # vehicles that have a controller
        self._replied: deque[tuple[str, str]] = deque()  # vehicle and text of each stop that was done
        self._refusals: dict[str, str] = {}  # text by vehicle

    def ask(self, name: str) -> None:
        """Ask a vehicle's plant to stop, unless it was asked or has answered."""
        if name not in self._asked and name not in self._answers:
            self._asked.add(name)
            self._query("stop", name)

    def run(self, wait_s: float, *, find_reasons: bool) -> list[str]:
        """Ask every plant that is seen; a line about each that has not answered in `wait_s`, or may not have been seen.

        `find_reasons`: also find out whether certificates are the reason, which takes a while.
        """
        here = self._here
        begin_s = time.monotonic()
        while (passed_s := time.monotonic() - begin_s) < wait_s:
            self._look_for_plants()
            if passed_s > FORWARD_AFTER_S:
                self._ask_controllers()
            self._take_replies()
            if self._is_complete():
                break
            if passed_s > DECLARED_S and not self._pending() and not here.unanswered():
                break
            time.sleep(POLL_S)
        self._take_replies()
        return self._failures(find_reasons=find_reasons)

    def _query(self, topic: str, name: str) -> None:
        key, payload, asker = topics.key(topic, name), Request().encode(), _user(self._here.certificate)
        self._here.session.get(key, self._received, payload=payload, attachment=asker, timeout=AGAIN_S, **_ALL)

    def _received(self, reply: zenoh.Reply) -> None:
        for address, content in _good([reply]):
            with suppress(MessageError):
                answer = Answer.decode(content, extra="ignore")
                if answer.done:
                    self._replied.append((address.vehicle, answer.text))
                else:
                    self._refusals[address.vehicle] = answer.text

    def _look_for_plants(self) -> None:
        """Ask the plants whose tokens are seen. A plant declares its token last, so one with a token answers."""
        for address in _alive(self._here.session, self._vehicle):
            role = address.role or ""
            if role == "plant":
                self.ask(address.vehicle)
            elif role.startswith("controller"):
                self._controlled.add(address.vehicle)

    def _ask_controllers(self) -> None:
        """Ask the controllers of plants that have not answered to pass the stop on: they have a link already."""
        for name in self._controlled - self._forwarded - self._answers.keys():
            self._forwarded.add(name)
            self._query("forward_stop", name)

    def _take_replies(self) -> None:
        while self._replied:
            name, text = self._replied.popleft()
            if name not in self._answers:  # a plant may answer by each carrier
                self._answers[name] = text
                self._on_answer(text)

    def _is_complete(self) -> bool:
        """Whether every plant that there may be has answered."""
        return bool(self._wanted) and all(name in self._answers for name in self._wanted)

    def _pending(self) -> set[str]:
        """Vehicles whose plant or controller may still answer."""
        return (self._asked | self._controlled) - self._answers.keys() - self._refusals.keys()

    def _failures(self, *, find_reasons: bool) -> list[str]:
        if self._is_complete():
            return []
        failures: list[str] = []
        for name in sorted(self._asked - self._answers.keys()):
            refused = self._refusals.get(name)
            failures.append(refused or f"the plant of {name} does not answer: {_MAY_ACT}")
        if self._network.mode == "client" and self._vehicle == "*":  # a router has forgotten a plant that hangs
            without_plant = sorted(self._controlled - self._asked - self._answers.keys())
            failures += [f"{name} has a controller, and no plant of it answers" for name in without_plant]
        failures += _unanswered(self._here, but=("controller", "recorder", "router"), why=find_reasons)
        if not self._answers and not failures:
            subject = "no plant" if self._vehicle == "*" else f"no plant of {self._vehicle}"
            failures.append(_nobody(self._network, subject))
        return failures


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
