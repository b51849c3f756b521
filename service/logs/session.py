"""A session of a log: a table of rows for each end, joined on the tick; and the plant's true states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import MAX_SIGNALS, Description, Truth
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import (
    NEVER,
    Batch,
    End,
    Header,
    Outcome,
    Received,
    Tail,
    read_batch,
    read_columns,
    row_dtype,
)
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Places = npt.NDArray[np.int32]
Table = npt.NDArray[np.void]

SessionKey = tuple[str, str]
"""A vehicle and a session."""

NO_TICK: Final = -1


class Missing(BaseModel, frozen=True):
    """Rows of one end that the log lacks."""

    vehicle: str
    session: str = Field(description="empty where the rows are of sessions of which the log has nothing")
    end: Literal["controller", "plant"]
    first_tick: int = Field(description="the first tick of the session that may lack its row")
    last_tick: int | None = Field(description="the last; null where the session's length is not known")
    rows: int = Field(description="how many are known to be missing; 0 where only the session's last batch is")

    def __str__(self) -> str:
        if not self.session:
            return f"{self.rows} of the {self.end}'s ticks in sessions of which the log has nothing"
        if self.last_tick is None:
            what = f"{self.rows} or more" if self.rows else "the last"
            return f"{what} of the {self.end}'s ticks, from tick {self.first_tick} of {self.session} on"
        return f"{self.rows} of the {self.end}'s ticks in {self.session}, ticks {self.first_tick} to {self.last_tick}"


class Unknown(BaseModel, frozen=True):
    """Ticks of a session that no figure counts, as the log does not hold what was in force then."""

    vehicle: str
    session: str
    first_tick: int
    last_tick: int

    def __str__(self) -> str:
        return (
            f"ticks {self.first_tick} to {self.last_tick} of {self.session} are left out: the log does not hold the "
            "gains, the reference and the law's state of them"
        )


class Extent(NamedTuple):
    """Recorded extent of a session: first tick, last tick (−1 for none) and rows of each end."""

    first: dict[End, int]
    last: dict[End, int]
    rows: dict[End, int]

    @property
    def ticks(self) -> int:
        """Ticks from the first to the last row of the controller."""
        return self.last["controller"] - self.first["controller"] + 1 if self.rows["controller"] else 0


@dataclass(frozen=True)
class Session:
    """Both ends' rows of a session in order, and their join on the tick. Rows of unknown ticks are left out.

    Times are on the end's monotonic clock, −1 for none [ns]; with `wall` added they are on its wall clock.

    Attributes:
        which: The session.
        settings: The configuration, each section from the role that owns it.
        descriptions: Of the roles as the session began.
        extent: What was recorded of it.
        controller: Columns tick, received_as, sent_as, received, sent, wall, measurement, command.
        plant: Columns tick, session_tick, sent_as, received_as, outcome, trip, answered (−1 for none), sent, received,
            wall, measurement, command.
        changes: Changes of gains and reference, in the order of their ticks.
        states: The controller's state before its first row and each first row after a gap, by the row's index.
        missing: Rows that the log lacks.
        unknown: Ticks that are left out, as the log does not hold what was in force then.
        k: Ticks with a row of either end. Shape (n,).
        at_controller: Index of the controller's row that computed each tick, or −1. Shape (n,).
        at_plant: Index of the plant's row of each tick, or −1. Shape (n,).
        acted: Index of the plant's row that first acted on the command that answers each tick, or −1. Shape (n,).
    """

    which: SessionKey
    settings: Settings
    descriptions: dict[str, Description]
    extent: Extent
    controller: Table
    plant: Table
    changes: list[Change]
    states: dict[int, dict[str, Any]]
    missing: list[Missing]
    unknown: list[Unknown]
    k: Integers
    at_controller: Places
    at_plant: Places
    acted: Places


class Entry(NamedTuple):
    """A batch of a trace, as it was recorded."""

    header: Header
    place: slice  # where its bytes are in `TraceIndex.payloads`
    first: int  # tick of the first row
    last: int  # highest tick; a late row is of an earlier one
    proof: int  # a tick of the other end whose row there must be
    changes: list[Change]
    record: list[Change]

    @property
    def after(self) -> int:
        """Number of the first row after it."""
        return self.header.first_row + self.header.rows


def table_of(
    end: End, wire: WireSpec, entries: Sequence[Entry], payloads: memoryview
) -> tuple[Table, dict[int, dict[str, Any]], int]:
    """One end's rows, from batches in order.

    Returns:
        The table, the controller's states as of `Session.states`, and how many batches of another wire are left out.
    """
    sizes = wire.actuators, wire.measurement.size, wire.command.size
    fitting = [one for one in entries if one.header.row_dtype == row_dtype(one.header.end, *sizes)]
    kinds = row_dtype(end, *sizes)
    wide = {"tick", "session_tick", "answered", "received", "sent"}
    columns = [
        (name, np.dtype(np.int64) if name in wide else kinds[name]) for name in kinds.names or () if name != "voltages"
    ]
    table = np.zeros(sum(one.header.rows for one in fitting), np.dtype([*columns, ("wall", np.dtype(np.int64))]))
    states = dict[int, dict[str, Any]]()
    filled, next_row = 0, -1
    for entry in fitting:
        header, payload = entry.header, bytes(payloads[entry.place])
        batch = Batch(header, read_columns(header, payload), Tail())
        if header.first_row != next_row and (whole := read_batch(payload)) is not None and whole.tail.state is not None:
            states[filled] = whole.tail.state
        next_row = entry.after
        rows = table[filled : filled + header.rows]
        for name, _ in columns:
            rows[name] = batch.columns[name]
        rows["received"], rows["sent"] = batch.times_ns("received"), batch.times_ns("sent")
        rows["wall"] = header.wall_ns - header.monotonic_ns
        filled += header.rows
    if end == "plant":
        table["answered"][table["answered"] == NEVER] = NO_TICK
    return table, states, len(entries) - len(fitting)


def join(
    controller: Table, plant: Table, first: float = -inf, last: float = inf
) -> tuple[Integers, Places, Places, Places]:
    """Ticks from `first` to `last` and the rows of each: k, at_controller, at_plant and acted of `Session`."""
    computed = np.flatnonzero(np.isin(controller["received_as"], (Received.FRAME, Received.SILENT)))
    acting = np.flatnonzero((plant["outcome"] == Outcome.ACTED) & (plant["answered"] != NO_TICK))
    k = np.sort(np.concatenate([controller["tick"][computed], plant["session_tick"]]))
    k = k[(np.diff(k, prepend=NO_TICK) > 0) & (k >= first) & (k <= last)]  # `unique` would keep 30 bytes a tick
    return (
        k,
        _places(controller["tick"][computed], computed, k),
        _places(plant["session_tick"], np.arange(len(plant)), k),
        _places(plant["answered"][acting], acting, k),
    )


def _places(ticks: Integers, places: npt.NDArray[np.intp], k: Integers) -> Places:
    """Of each tick k, where it stands first, or −1."""
    ticks, first = np.unique(ticks, return_index=True)
    if not len(ticks):
        return np.full(len(k), -1, dtype=np.int32)
    at = np.minimum(np.searchsorted(ticks, k), len(ticks) - 1)
    return np.where(ticks[at] == k, places[first][at], -1).astype(np.int32)


class TrueStates:
    """Collects the true states of some sessions of a vehicle, by name with the number of motors."""

    def __init__(self, actuators: Mapping[str, int]) -> None:
        self._actuators = actuators
        self._states: dict[str, dict[int, tuple[float, ...]]] = {session: {} for session in actuators}
        self._signals: dict[str, dict[str, dict[int, float]]] = {session: {} for session in actuators}

    def add(self, data: bytes) -> None:
        """Add a message, unless it is of another session; of a tick, the first counts.

        Raises:
            ValueError: It is malformed: anyone on the network may publish one, of any tick and any plant's motors.
        """
        truth = Truth.model_validate_json(data)
        if truth.session is None or truth.session not in self._actuators or (k := truth.session_tick) is None:
            return
        signals = self._signals[truth.session]
        if not 0 <= k < NEVER or len(truth.voltages) != self._actuators[truth.session]:
            raise ValueError("a true state of no tick of its session")
        if len({*signals, *truth.signals}) > MAX_SIGNALS:
            raise ValueError("more signals than a plant has")
        self._states[truth.session].setdefault(k, (k, *truth.attitude, *truth.rate, *truth.voltages))
        for name, value in truth.signals.items():
            signals.setdefault(name, {}).setdefault(k, nan if value is None else value)

    def rows(self, session: str) -> Array:
        """Tick, q, ω and the motors' voltages, ascending. Shape (n, 8 + actuators)."""
        rows = [row for _, row in sorted(self._states[session].items())]
        return np.array(rows, np.float64).reshape(-1, 8 + self._actuators[session])

    def signals(self, session: str) -> dict[str, Array]:
        """The plant's further signals by name, a value for each of `rows`; NaN where it is not known. Shapes (n,)."""
        ticks = sorted(self._states[session])
        return {
            name: np.array([values.get(k, nan) for k in ticks])
            for name, values in sorted(self._signals[session].items())
        }
