"""Intake: reads JSON that anyone on the network may have sent, with bounded work.

A parser holds Python's lock, so a loop in the same process waits for it. pydantic makes an object of every error, and
a payload of nothing but unknown keys has one for each: the number of values is bounded before anything is parsed.
"""

from __future__ import annotations

from typing import Final, TypeVar

from pydantic import BaseModel, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import MAX_POINTS
from aeroloop.protocol.wording import problem

M = TypeVar("M", bound=BaseModel)

FEW: Final = 256
"""Values of any message but those below: a claim has 17, a request that injects 64 faults 65. Refused in 0.4 ms."""
STATUS: Final = 2048
"""Values of a status with 128 faults, twice. For `Tenure`, which leaves most of them unread."""
REFERENCE: Final = 4 * MAX_POINTS + FEW
"""Values of what may hold a reference of `MAX_POINTS` points, which takes some 10 ms."""


class IntakeError(AeroloopError):
    """The payload is no such message; one line that says why."""


def few(payload: bytes, most: int = FEW) -> bool:
    """Whether a payload has at most so many values, by its commas. Takes no longer the more there are."""
    return len(payload.split(b",", most)) <= most


def read(model: type[M], payload: bytes, most: int = FEW) -> M:
    """Read a message of at most so many values.

    Raises:
        IntakeError: It has more, or is no such message.
    """
    if not few(payload, most):
        raise IntakeError(f"not a {model.__name__}: more than {most} values")
    try:
        return model.model_validate_json(payload)
    except ValidationError as error:
        raise IntakeError(f"not a {model.__name__}: {problem(error, model)}") from None
