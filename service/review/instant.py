"""Instants of a log: all that is known of one tick, and the next tick at which a condition holds.

What the ends sent and received stands in their traces, what the controller computed is computed again, and a true state
is the latest that the plant published.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from difflib import get_close_matches
from math import isnan
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import EventKind
from aeroloop.protocol.messages.trace import Outcome, Received, Sent
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.registry import configured_gains, initial_state, law_of
from aeroloop.service.logs.columns import Column, columns_of
from aeroloop.service.logs.frames import Direction, FrameSignal, read_frame
from aeroloop.service.logs.recording import INDEXING, Progress, Recording, ReviewError
from aeroloop.service.logs.ticks import recompute, with_known_law
from aeroloop.service.review.events import happened, read_messages
from aeroloop.service.review.report import Mark
from aeroloop.service.theorem.bounds import coordinates, norm, rotation, times
from aeroloop.service.theorem.premises import plant_bounds

NEAR_S: Final = 1.0  # events so near are shown [s]
AT_A_TIME: Final = 4096  # ticks that are searched at a time
_COMPARED: Final[dict[str, Callable[[Any, float], Any]]] = {
    ">=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">": operator.gt, "<": operator.lt,
}  # fmt: skip


class Frame(BaseModel, frozen=True):
    """A frame of a tick."""

    sent_as: str = Field(description="frame, silent or none; missing where the log lacks the row")
    received_as: str = Field(description="by the other end; of a command with what the plant did with it")
    octets: str = Field(description="its bytes, in hexadecimal; of a silent one those that it repeats")
    counter: int | None
    signals: list[FrameSignal]


class Instant(BaseModel, frozen=True):
    """All that is known of a tick; `values` has the columns of an exported table, by their names."""

    tick: int
    time_s: float = Field(description="on the law's clock [s]")
    vehicle: str
    session: str
    measured: str = Field(description="when it was measured, UTC; empty where not known")
    measurement: Frame
    command: Frame
    values: dict[str, float | bool | None] = Field(description="empty where the tick has no valid measurement")
    gains: dict[str, list[float]]
    state_after: dict[str, list[float]] = Field(
        description="of the law; `values` has what it used; empty where the controller did not compute the tick"
    )
    coordinates: dict[str, list[float]] = Field(
        description="z₁, z₂ of the measurement, ‖z‖; V (C.24) where the plant's damping is known; the paper's law only"
    )
    clocks_s: dict[str, float | None] = Field(
        description="sent and received, each on the monotonic clock of the end that did [s]"
    )
    notes: list[str] = Field(description="what was late, missing, saturated or without a valid value")
    events: list[Mark] = Field(description="within a second")


class Instants:
    """A session of a log, read once. Raises ReviewError as `Recording` does.

    `law_unknown` is why nothing is known that the law alone computes; None if it is.
    """

    def __init__(
        self, paths: Sequence[Path], session: str | None = None, vehicle: str | None = None,
        progress: Progress | None = None,
    ) -> None:  # fmt: skip
        recording = Recording(paths, progress)
        self.which = recording.choose(session, vehicle)
        its, self.law_unknown = with_known_law(recording.session(self.which))
        self._session = its
        self.settings, self._period = its.settings, its.settings.loop.period
        if not len(its.k):
            raise ReviewError(f"{recording.name} holds no tick of {'/'.join(self.which)}")
        span = int(its.k[0]), int(its.k[-1])
        messages = read_messages(recording, self.which, its.settings.wire.actuators)
        self.marks = [mark for mark in happened(messages, its, span, alone=False)[0] if mark.time_s is not None]
        self._truths = messages.truths
        self._ticks = recompute(its, progress and (lambda share: progress(INDEXING + (1 - INDEXING) * share))).ticks
        law = law_of(its.settings.law, self._period, its.settings.wire.actuators)
        self._gains, self._state = configured_gains(law), initial_state(law)
        self.first, self.last = span

    def tick_at(self, at: int | float) -> int:
        """The tick at an instant: a tick, as an int, or a time on the law's clock [s]. Raises ReviewError."""
        tick = at if isinstance(at, int) else round(at / self._period)
        if not self.first <= tick <= self.last:
            ends = f"{self.first * self._period:g} s to {self.last * self._period:g} s"
            raise ReviewError(f"the session has ticks {self.first} to {self.last}, {ends}, and none {tick}")
        return tick

    def find(self, condition: str, after: int) -> int | None:
        """The first tick after another at which a condition holds: an event's kind, such as trip, or NAME > NUMBER."""
        found = re.fullmatch(r"\s*(\w+)\s*(>=|<=|==|!=|>|<)\s*(\S+)\s*", condition)
        if found is None:
            kind = {"trip": "tripped", "mark": "marked"}.get(word := condition.strip().lower(), word)
            if kind not in get_args(EventKind) and kind != "change":
                raise ReviewError(
                    f"no condition: {condition}; one is 'attitude_error_deg > 5', another is trip or mark"
                )
            at = [round((mark.time_s or 0) / self._period) for mark in self.marks if mark.kind == kind]
            return next((tick for tick in (min(tick, self.last) for tick in at) if tick > after), None)
        name, compared, number = found.groups()
        try:
            limit = float(number)
        except ValueError:
            raise ReviewError(f"{number} is no number") from None
        begin = int(np.searchsorted(self._ticks.k, after, "right"))
        for first in range(begin, len(self._ticks.k), AT_A_TIME):
            columns = {column.name: column for column in self._columns(slice(first, first + AT_A_TIME))}
            if name not in columns or columns[name].values.dtype == object:
                near = ", ".join(get_close_matches(name, columns, 5, 0.3))
                raise ReviewError(f"a table of this log has no column {name}" + (f"; it has {near}" if near else ""))
            if (holds := _COMPARED[compared](columns[name].values, limit)).any():
                return int(self._ticks.k[first + int(np.argmax(holds))])
        return None

    def at(self, at: int | float) -> Instant:
        """All that is known of a tick, as of `tick_at`."""
        tick, session, period = self.tick_at(at), self._session, self._period
        place = int(np.searchsorted(session.k, tick))
        known = session.k[place] == tick
        rows = {}
        for name, places, table in (
            ("controller", session.at_controller, session.controller), ("plant", session.at_plant, session.plant),
            ("acted", session.acted, session.plant),
        ):  # fmt: skip
            rows[name] = table[places[place]] if known and places[place] >= 0 else None
        i = int(np.searchsorted(self._ticks.k, tick))
        valid = i < len(self._ticks.k) and self._ticks.k[i] == tick
        computed = valid and not np.isnan(self._ticks.state[i]).any()
        columns = self._columns(slice(i, i + 1)) if valid else []
        skipped = ("tick", "time_s", "published_ns", "vehicle", "session")
        values = {column.name: _value(column) for column in columns if column.name not in skipped}
        wall_ns = int(self._ticks.wall_ns[i]) if valid else 0
        measured = datetime.fromtimestamp(wall_ns * 1e-9, UTC).isoformat(timespec="milliseconds") if wall_ns > 0 else ""
        plant, controller, acted = (rows[name] for name in ("plant", "controller", "acted"))
        clocks = (
            ("plant sent the measurement", plant, "sent"), ("controller received it", controller, "received"),
            ("controller sent the command", controller, "sent"), ("plant received it", acted, "received"),
        )  # fmt: skip
        seconds = {name: None if row is None or row[at] <= 0 else int(row[at]) * 1e-9 for name, row, at in clocks}
        return Instant(
            tick=tick, time_s=round(tick * period, 9), vehicle=self.which[0], session=self.which[1], measured=measured,
            measurement=self._frame("measurement", plant, controller, tick),
            command=self._frame("command", controller, acted, tick),
            values=values,
            gains=_split(self._gains, self._ticks.gains[i]) if valid else {},
            state_after=_split(self._state, self._ticks.state_next[i]) if computed else {},
            coordinates=self._coordinates(i) if valid else {},
            clocks_s=dict.fromkeys(seconds) if self.settings.loop.lockstep else seconds,
            notes=[*self._notes(tick, plant, controller, acted), *_saturated(values), *self._without_law()],
            events=[mark for mark in self.marks if abs((mark.time_s or 0) - tick * period) <= NEAR_S],
        )  # fmt: skip

    def _columns(self, which: slice) -> list[Column]:
        return columns_of(self.which, self._ticks.where(which), self._truths, self.settings)

    def _frame(self, direction: Direction, sender: Any, receiver: Any, tick: int) -> Frame:
        """A frame of a tick from both ends' rows; of a silent one what it repeats."""
        sent_as = "missing" if sender is None else Sent(int(sender["sent_as"])).name.lower()
        if direction == "measurement":
            received_as = "not received"
            if receiver is not None:
                received_as = f"received as {Received(int(receiver['received_as'])).name.lower()}"
        else:
            received_as = "not received" if receiver is None else _outcome(receiver)
        octets = b""
        if sender is not None and sender["sent_as"] in (Sent.FRAME, Sent.SILENT):
            table, name = (
                (self._session.plant, "session_tick")
                if direction == "measurement"
                else (self._session.controller, "tick")
            )
            before = np.flatnonzero((table["sent_as"] == Sent.FRAME) & (table[name] <= tick))
            octets = table[direction][before[-1]].tobytes() if len(before) else b""
        read = read_frame(self.settings.wire, direction, octets)
        counter, signals = read or (None, [])
        return Frame(sent_as=sent_as, received_as=received_as, octets=octets.hex(" "), counter=counter, signals=signals)

    def _coordinates(self, i: int) -> dict[str, list[float]]:
        """z₁, z₂ and V of the paper's law at the measurement, with the gains in force."""
        settings, ticks = self.settings, self._ticks.where(slice(i, i + 1))
        if not isinstance(settings.law, AdaptiveSettings):
            return {}
        sign, estimate, C1, Gamma = ticks.state_next[:, 3], ticks.state[:, :3], ticks.gains[:, :3], ticks.gains[:, 6:9]
        omega_d = times(rotation(ticks.attitude), ticks.desired_rate)
        z = coordinates(ticks.attitude, ticks.rate, ticks.desired, omega_d, sign, C1)
        found = {"z1": z.z1[0].tolist(), "z2": z.z2[0].tolist(), "z": norm(np.hstack([z.z1, z.z2])).tolist()}
        if (theta := plant_bounds(settings, stated=True).theta) is not None:
            error, J = theta - estimate[0], np.array(settings.law.inertia)
            V = z.z1[0] @ z.z1[0] + z.z2[0] @ (J * z.z2[0]) / 2 + error @ (error / Gamma[0]) / 2  # (C.24)
            found["V"] = [float(V)]
        return found

    def _without_law(self) -> list[str]:
        return [] if self.law_unknown is None else [f"without its law: {self.law_unknown}"]

    def _notes(self, tick: int, plant: Any, controller: Any, acted: Any) -> list[str]:
        """What was late, missing or refused of a tick."""
        rows, found = self._session.controller, list[str]()
        if ((rows["received_as"] == Received.LATE) & (rows["tick"] == tick)).any():
            found.append("the measurement was received late: its levels hold from the next tick on")
        if controller is not None and controller["sent_as"] == Sent.NONE:
            found.append("the controller sent no command")
        elif acted is None:
            found.append("no command that answers this measurement acted")
        if plant is not None and plant["trip"]:
            found.append("the plant tripped at this tick")
        if plant is not None and plant["outcome"] not in (Outcome.NONE, Outcome.ACTED):
            found.append(f"the command received before it was {_outcome(plant)}")
        lacking = [end for end, row in (("plant", plant), ("controller", controller)) if row is None]
        return [*found, *(f"the log lacks the {end}'s row" for end in lacking)]


def _outcome(row: Any) -> str:
    return Outcome(int(row["outcome"])).name.lower()


def _saturated(values: dict[str, Any]) -> list[str]:
    names = [
        name.removeprefix("saturated_") for name, value in values.items() if name.startswith("saturated_") and value
    ]
    return [f"at the quantizer's outermost level: {', '.join(names)}"] if names else []


def _value(column: Column) -> float | bool | None:
    value = float(column.values[0])
    return None if isnan(value) else bool(value) if column.boolean else value


def _split(sizes: Any, row: Any) -> dict[str, list[float]]:
    """Named parts of a row: of each name as many numbers as its initial value has."""
    found, at = dict[str, list[float]](), 0
    for name, first in sizes.items():
        found[name] = row[at : at + len(first)].tolist()
        at += len(first)
    return found
