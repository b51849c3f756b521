"""Base of all messages; operator requests, references, gains and changes, with their bounds.

A reference gives roll, pitch and yaw over time. A new one is approached from the one before within `within_s`: angle,
rate and acceleration never jump.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import pi
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    StringConstraints,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wording import problem

MAX_POINTS: Final = 10_000
MAX_WITHIN_S: Final = 600.0

MAX_VALUES: Final = 256  # values of an ordinary message: a request that injects 64 faults has 65
REFERENCE_VALUES: Final = 4 * MAX_POINTS + MAX_VALUES
"""Values of what may hold a reference of `MAX_POINTS` points, which takes some 10 ms to parse."""


class MessageError(AeroloopError):
    """The payload is no such message; one line that says why."""


class Message(BaseModel):
    """Base of all messages. Unknown fields are refused, so that a message of another version is not read in part."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    max_values: ClassVar[int] = MAX_VALUES

    def encode(self) -> bytes:
        """The message as JSON."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes, *, extra: Literal["ignore", "forbid"] | None = None) -> Self:
        """Read JSON that anyone on the network may have sent; `extra` replaces the model's rule for unknown fields.

        A parser holds Python's lock, so a loop in the same process waits for it, and pydantic makes an object of every
        error: 100 ms for 2 MB of unknown keys. So values are counted, by their commas, before anything is parsed.

        Raises:
            MessageError: It has more than `max_values` values, or is no such message.
        """
        if payload.count(b",") > cls.max_values:
            raise MessageError(f"not a {cls.__name__}: more than {cls.max_values} values")
        try:
            return cls.model_validate_json(payload, extra=extra)
        except ValidationError as error:
            raise MessageError(f"not a {cls.__name__}: {problem(error, cls)}") from None


Angles = tuple[FiniteFloat, FiniteFloat, FiniteFloat]  # roll, pitch, yaw [deg]
Frequency = Annotated[float, Field(ge=0, le=100)]


class Sinusoid(Message):
    """amplitude · sin(frequency · t) on each of roll, pitch and yaw. The default is the paper's experiment, C.5."""

    kind: Literal["sinusoid"] = Field(default="sinusoid", description="which reference")
    amplitude: Angles = Field(default=(0.0, 40.0, 100.0), description="of roll, pitch, yaw [deg]")
    frequency: tuple[Frequency, Frequency, Frequency] = Field(
        default=(0.0, 0.1 * pi, 0.05 * pi), description="of roll, pitch, yaw [rad/s]"
    )


class Hold(Message):
    """One constant attitude."""

    kind: Literal["hold"] = Field(default="hold", description="which reference")
    attitude: Angles | None = Field(
        default=None, description="roll, pitch, yaw [deg]; null: where the body is brought to rest, or 0 at the start"
    )


AS_PUBLISHED: Final = {"as_published": True}
"""Context of validation for what a role published, perhaps one of a version that had no `Points.interpolation`."""


class Points(Message):
    """Attitudes at given times, joined smoothly, from rest to rest; the last one is held."""

    kind: Literal["points"] = Field(default="points", description="which reference")
    times: list[FiniteFloat] = Field(min_length=2, max_length=MAX_POINTS, description="rising, from 0 [s]")
    attitudes: list[Angles] = Field(min_length=2, max_length=MAX_POINTS, description="roll, pitch, yaw each [deg]")
    interpolation: Literal["monotone", "differences"] = Field(
        default="monotone",
        description="monotone: between two points each angle stays between theirs; differences: smoother where the "
        "points are dense, and far beyond them where they are not. Left out in a log, it is differences",
    )

    @model_validator(mode="after")
    def _as_it_was_joined(self, info: ValidationInfo) -> Points:
        """Join the points of an older log as the controller did that followed them."""
        if info.context == AS_PUBLISHED and "interpolation" not in self.model_fields_set:
            return self.model_copy(update={"interpolation": "differences"})
        return self

    @model_validator(mode="after")
    def _a_time_for_each(self) -> Points:
        if len(self.times) != len(self.attitudes):
            raise ValueError(f"{len(self.times)} times for {len(self.attitudes)} attitudes")
        if self.times[0] != 0:
            raise ValueError("the first time must be 0")
        if any(after - before < 1e-3 - 1e-9 for before, after in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must rise by at least a millisecond")
        return self


class Stream(Message):
    """Set-points received on the `reference` topic; the last one is held until the next."""

    kind: Literal["stream"] = Field(default="stream", description="which reference")
    timeout_s: float = Field(default=0.5, gt=0, le=60, description="a stream silent longer is reported and held [s]")
    within_s: float = Field(default=0.2, ge=0.02, le=60, description="time to reach each set-point [s]")


Reference = Annotated[Sinusoid | Hold | Points | Stream, Field(discriminator="kind")]


def in_words(reference: Reference) -> str:
    """A reference in a few words."""
    match reference:
        case Sinusoid(amplitude=angles):
            words = "a sinusoid of "
        case Hold(attitude=angles):
            words = ""
        case Points(times=times):
            return f"{len(times)} points over {times[-1]:g} s"
        case _:
            return "a stream of set-points"
    if angles is None:
        return "where it is"
    return f"{words}roll, pitch, yaw " + ", ".join(f"{angle:.4g}°" for angle in angles)


class Setpoint(Message):
    """One message of a live stream of set-points."""

    attitude: Angles = Field(description="roll, pitch, yaw [deg]")


MAX_GAINS: Final = 32  # the most gains of a law, and numbers of a gain


Gain = Annotated[
    tuple[FiniteFloat, ...],
    Field(min_length=1, max_length=MAX_GAINS),
    BeforeValidator(
        lambda gain: (gain,) if isinstance(gain, int | float) else gain,
        json_schema_input_type=float | tuple[float, ...],
    ),
]
"""The numbers of a gain; a single one may stand without brackets."""


class Gains(Message, extra="allow"):
    """Gains of the law by name, such as C1, C2 and Gamma of the paper's. One left out, or null, stays as it is.

    The law of the session bounds them, and has no others.
    """

    __pydantic_extra__: dict[Annotated[str, StringConstraints(max_length=64)], Gain | None]

    if TYPE_CHECKING:

        def __init__(self, **gains: float | Sequence[float] | None) -> None: ...

        def __getattr__(self, name: str) -> tuple[float, ...] | None: ...

    @model_validator(mode="after")
    def _not_too_many(self) -> Gains:
        if len(self.named) > MAX_GAINS:
            raise ValueError(f"a law has {MAX_GAINS} gains at the most")
        return self

    @property
    def named(self) -> dict[str, tuple[float, ...]]:
        """The gains given, by name."""
        return {name: gain for name, gain in (self.__pydantic_extra__ or {}).items() if gain is not None}

    def over(self, before: Gains) -> Gains:
        """These gains, and those of `before` that are not given here."""
        return Gains.model_validate(before.named | self.named)


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("every character must be printable")
    return text


Line = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
"""A line for people to read."""


class Request(Message):
    """A request without arguments: arm, stop, stand down, recall."""


class Mark(Message):
    """A mark in the log."""

    text: Line = Field(description="what an operator wants to find again")


class Track(Message):
    """Follow another reference from the next tick on."""

    max_values = REFERENCE_VALUES
    reference: Reference | None = Field(description="null: the one that the controller is configured with")
    within_s: float | None = Field(
        default=None,
        ge=0.02,
        le=MAX_WITHIN_S,
        description="time to reach it, or to come to rest; null: the shortest [s]",
    )


class Change(Message):
    """Gains and reference from a tick on, in the trace at the start of every session and at every change.

    With the trace's rows, the changes and the description, a session can be computed again to the last bit.
    """

    session: str
    tick: int = Field(description="the first tick k of the law to which it applies")
    gains: Gains | None = Field(default=None, description="null: as before")
    reference: Reference | None = Field(default=None, description="null: as before")
    within_s: float = Field(default=0.0, description="time to reach the reference from the one before; 0: a jump [s]")
    start: Angles | None = Field(
        default=None, description="where the approach to it starts, at rest; null: at the reference before [deg]"
    )
    brake_s: Angles | None = Field(
        default=None, description="time in which roll, pitch, yaw each brake to rest first; null: a single quintic [s]"
    )
    run_up_s: Angles | None = Field(
        default=None, description="time of it in which each runs up to the reference's rate at last [s]"
    )
    here: tuple[Angles, Angles, Angles] | None = Field(
        default=None,
        description="roll, pitch, yaw at the tick on the reference before, where the approach starts in motion, with "
        "their rates and accelerations [rad, rad/s, rad/s²]; null where `start` is given, and for a jump",
    )

    @model_serializer(mode="wrap")
    def _without_null_times(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what is null of `brake_s`, `run_up_s` and `here`."""
        optional = ("brake_s", "run_up_s", "here")
        return {name: value for name, value in dump(self).items() if value is not None or name not in optional}


def in_force(changes: Iterable[Change]) -> list[Change]:
    """The last gains and the last reference that changes set, each as one change, in the order of their ticks.

    With a law's state they determine all later commands: a change of the reference has where its approach starts.
    """
    gains: Change | None = None
    reference: Change | None = None
    for change in changes:
        if change.gains is not None:
            whole = change.gains if gains is None or gains.gains is None else change.gains.over(gains.gains)
            gains = Change(session=change.session, tick=change.tick, gains=whole)
        if change.reference is not None:
            reference = change.model_copy(update={"gains": None})
    return sorted((one for one in (gains, reference) if one is not None), key=lambda one: one.tick)


class Inject(Message):
    """Inject faults into an emulated plant, all between the same two ticks or, if one is refused, none."""

    faults: list[Annotated[str, Field(max_length=200)]] = Field(
        default_factory=list, max_length=64, description="each signal:kind[=value][@start[..end]], seconds from now"
    )
    clear: bool = Field(default=False, description="first remove all faults, configured ones too")


class Advance(Message):
    """Run a plant in lockstep that steps on request for this time."""

    seconds: float = Field(gt=0, le=86_400, description="of the plant's time [s]")


class Answer(Message):
    """A role's answer to an operator."""

    done: bool
    text: str = Field(description="one line for a person: what was done, or why not")
