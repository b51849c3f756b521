"""Operator commands: status of every role on the network, arm, stop, release, gains and reference.

Each is a Zenoh query that the addressed role answers. Status is answered by the role's network thread from the last
published one, so it never stalls a loop; the other commands are taken between two ticks.
"""

from __future__ import annotations

import csv
import time
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Final

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord, Status
from aeroloop.protocol.messages.operator import Answer, Ask, Message, Points
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


def show(network: NetworkSettings, vehicle: str, *, last: bool = False) -> SessionRecord:
    """Gains and reference of a vehicle's controller: of several, the one with the session, if any.

    With `last`, those of the last session that ended, by the plant's record.

    Raises:
        NetworkError: The network cannot be joined.
        OperatorError: No controller answers, or the plant has no record.
    """
    found: list[SessionRecord] = []
    with join(network) as session:
        deadline = time.monotonic() + GATHER_S
        while time.monotonic() < deadline and not any(record.session for record in found):
            for payload in _replies(session, "show", vehicle, Ask()):
                with suppress(ValidationError):
                    record = SessionRecord.model_validate_json(payload)
                    found += [record] if (record.ended is not None) == last else []
            time.sleep(0.02)
    if not found:
        which = f"plant of {vehicle} with a record of a session" if last else f"controller of {vehicle}"
        raise OperatorError(f"no {which} answers at {network.rendezvous}")
    return next((record for record in found if record.session), found[0])


def read_points(path: Path) -> Points:
    """Attitudes over time from a CSV file: columns time [s], roll, pitch, yaw [deg], with or without a heading.

    Raises:
        OperatorError: It cannot be read, or is no such table; names the line.
    """
    times: list[float] = []
    attitudes: list[tuple[float, float, float]] = []
    number = 1  # of the line
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows, first = csv.reader(file), True
            while True:
                number = rows.line_num + 1  # of the next row, should it be unreadable
                if (row := next(rows, None)) is None:
                    break
                number, heading = rows.line_num, first and bool(row) and not _is_number(row[0])
                first = False
                if not row or heading:
                    continue
                if (problem := _problem(row, times)) is not None:
                    raise OperatorError(f"{path}, line {number}: {problem}")
                time_s, roll, pitch, yaw = (float(cell) for cell in row)
                times.append(time_s)
                attitudes.append((roll, pitch, yaw))
        return Points(times=times, attitudes=attitudes)
    except csv.Error as error:
        raise OperatorError(f"{path}, line {number}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise OperatorError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except ValidationError as error:
        raise OperatorError(f"{path}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from None


def _problem(row: list[str], times: list[float]) -> str | None:
    """The error in a row of a table of points, if there is one."""
    if len(row) != 4 or not all(_is_number(cell) for cell in row):
        return f"expected four numbers (time [s], roll, pitch, yaw [deg]), not {','.join(row)!r}"
    values = [float(cell) for cell in row]
    if not all(isfinite(value) for value in values):
        return f"every number must be finite, not {','.join(row)!r}"
    if not times and values[0] != 0:
        return f"the first time must be 0, not {row[0]}"
    if times and values[0] <= times[-1]:
        return f"times must rise, and {row[0]} does not after {times[-1]:g}"
    return None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


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
    return [Answer.model_validate_json(payload) for payload in _replies(session, topic, vehicle, message)]


def _replies(session: zenoh.Session, topic: str, vehicle: str, message: Message) -> list[bytes]:
    replies = session.get(
        topics.key(topic, vehicle), payload=message.encode(), timeout=ANSWER_S, target=zenoh.QueryTarget.ALL
    )
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
