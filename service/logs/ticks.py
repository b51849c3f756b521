"""Ticks of a session in columns, as the controller received and computed them; review, figures and export use them.

A row of the controller states what it received for a tick: a frame; silence, which repeats the levels of the last
frame; or a late frame, whose levels hold from the next tick on. So one loop over `Controller.tick` computes all of it
again, bit for bit; after missing rows, the log has the controller's state.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from math import nan
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from aeroloop.protocol.messages.operator import Change, Gains
from aeroloop.protocol.messages.trace import Received, Sent
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import CodedQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.registry import (
    LawError,
    UnknownLawSettings,
    configured_gains,
    law_function,
    law_of,
    no_such_gain,
)
from aeroloop.service.logs.recording import Progress, ReviewError
from aeroloop.service.logs.session import Array, Integers, Places, Session, Table

Flags = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.int16] | Array  # integers, or the doubles of a wire that is not quantized

AT_A_TIME: Final = 8192  # rows that are turned into Python's objects at a time
WINDOW: Final = 512  # ticks per fit of the clocks' offset; two crystals drift apart by less than 1 µs per second
_LEAST: Final = 16


class Ticks(NamedTuple):
    """Ticks in order, a row each. What is unknown is NaN, a time −1. Shapes (n,) and (n, columns)."""

    k: Integers  # tick of the law; its time is k·period
    wall_ns: (
        Integers  # when it was measured, on the plant's wall clock; on the controller's where the plant's row lacks
    )
    sent_ns: Integers  # when the measurement was sent, on the plant's monotonic clock; −1 where it was not
    latency_ns: Array  # from then until its answer was received; as both delays NaN in lockstep, where the plant waits
    measurement_delay_ns: Array  # from the plant's sending to the controller's receiving; see `clock_offset`
    command_delay_ns: Array  # from the controller's sending to the plant's receiving
    attitude: Array  # q as measured
    desired: Array  # q_d
    rate: Array  # ω as measured, body frame [rad/s]
    attitude_error: Array  # ε̃
    rate_error: Array  # ω_e, body frame [rad/s]
    voltages: Array  # what was commanded; NaN where nothing was, or no valid value [V]
    unquantized: Array  # u before quantization [V]
    gains: Array  # the law's gains, one beside the other
    state: Array  # the law's named state that it used; of the paper's θ̂ [N·m·s/rad] and the sign of the equilibrium
    state_next: Array  # the same after the tick; of the last tick before where the controller computed nothing

    @property
    def desired_rate(self) -> Array:
        """ω_d in the body frame [rad/s]. Shape (n, 3)."""
        return self.rate - self.rate_error

    def where(self, chosen: npt.NDArray[np.bool_] | Integers | slice) -> Self:
        """The ticks that a mask, index or slice selects."""
        return type(self)(*(column[chosen] for column in self))  # type: ignore[arg-type]  # as they were


class Recomputed(NamedTuple):
    """A session, computed again."""

    ticks: Ticks  # with a valid measurement, up to the last answered; errors are the plant's own where only it ran
    answered: Integers  # ticks that a command answered, be it one without a valid value. Shape (m,)
    voltages: Array  # what was commanded at them [V]. Shape (m, actuators)
    missed: Integers  # ticks up to the last answered one that the plant measured and the controller did not compute
    unsent: tuple[int, int]  # how many of the judged measurements, and of the answers, were silent
    measurements: Codes  # codes of all measurement frames. Shape (n, 6)
    commands: Codes  # codes of all command frames. Shape (n, actuators)
    offset_ns: tuple[float, float]  # between the ends' clocks, at the first and the last tick where it is known, or NaN


class LoggedController:
    """The controller of a session, which answers its rows again, one after the other.

    With other `settings` than the session's, logged changes of what they set may be `ignored`: keys of the
    configuration, such as `law.C2` or `reference.kind`. It `resumes` from the recorded state where rows are missing.
    `made_by` is the class of its controller. `state_before` is the law's state before the last row. Of a session of
    `with_known_law` whose law is unknown, it computes all but the law.
    """

    def __init__(
        self,
        session: Session,
        settings: Settings | None = None,
        *,
        ignored: Collection[str] = (),
        resumes: bool = True,
        made_by: type[Controller] = Controller,
    ) -> None:
        self.settings = settings = settings or session.settings
        self.controller = made_by(settings.wire, settings.law, settings.reference, settings.loop.period)
        self.state_before = np.array(self.controller.last_valid["state_next"])
        self._rows = session.controller
        self._states = {i: state for i, state in session.states.items() if resumes or i == 0}
        self._changes: deque[Change] = deque(session.changes)
        self._ignored = set(ignored)
        if isinstance(settings.law, UnknownLawSettings):
            self.controller.leave_out_law()
            self._ignored.add("law.kind")

    def answers(self, progress: Progress | None = None) -> Iterator[bytes | None]:
        """The command that answers each row: a frame, UNCHANGED, or None. Raises ReviewError as `resume`."""
        rows, state = self._rows, self.controller.last_valid["state_next"]
        for begin in range(0, len(rows), AT_A_TIME):
            some = rows[begin : begin + AT_A_TIME]
            columns = (some[name].tolist() for name in ("tick", "received_as", "measurement"))
            for i, (tick, received_as, frame) in enumerate(zip(*columns, strict=True), begin):
                self.resume(i)
                self.state_before[:] = state
                if received_as == Received.LATE:
                    self.controller.hold(frame)
                if received_as in (Received.FRAME, Received.SILENT):
                    self.change(tick)
                    yield self.controller.tick(frame if received_as == Received.FRAME else UNCHANGED, tick)
                else:
                    yield None
            if progress is not None:
                progress(min(1.0, (begin + AT_A_TIME) / len(rows)))

    def change(self, k: int) -> None:
        """Apply the logged changes of gains and reference up to tick k. Raises LawError as `Controller.apply`."""
        while self._changes and self._changes[0].tick <= k:
            self.controller.apply(without(self._changes.popleft(), self._ignored))

    def resume(self, i: int) -> None:
        """Continue from the state before row i, where the log has it. Raises ReviewError if it is of no controller."""
        if i in self._states:
            try:
                self.controller.restore(ControllerSnapshot.model_validate(self._states[i]))
            except ValidationError as error:
                why = str(error).splitlines()[0]
                raise ReviewError(f"the log has a state that is not of this version: {why}") from None


def with_known_law(session: Session) -> tuple[Session, str | None]:
    """The session, as it can be computed here, and why its law cannot be had, if so: None if it can.

    Without its law, a session's attitude, errors, voltages and times are known, but not what the law alone computes:
    voltages before quantization, gains and state.
    """
    settings = session.settings
    try:
        law = law_of(settings.law, settings.loop.period, settings.wire.actuators)
        law_function(law)
        sizes = {name: len(gain) for name, gain in configured_gains(law).items()}
        for change in session.changes:
            for name, gain in change.gains.named.items() if change.gains is not None else ():
                if sizes.get(name) != len(gain):
                    raise no_such_gain(settings.law.kind, name, len(gain))
    except (LawError, PluginError) as error:
        unknown = UnknownLawSettings.model_validate(settings.law.model_dump())
        return replace(session, settings=settings.model_copy(update={"law": unknown})), str(error)
    return session, None


def without(change: Change, keys: Collection[str]) -> Change:
    """A change without what these keys of the configuration set: a reference, gains; with `law.kind` all gains."""
    kept = change
    if any(key == "reference" or key.startswith("reference.") for key in keys):
        kept = kept.model_copy(update={"reference": None})
    if change.gains is not None:
        gains = {name: gain for name, gain in change.gains.named.items() if f"law.{name}" not in keys}
        has_any = bool(gains) and "law.kind" not in keys
        kept = kept.model_copy(update={"gains": Gains.model_validate(gains) if has_any else None})
    return kept


def recompute(session: Session, progress: Progress | None = None) -> Recomputed:
    """Compute a session again: what the controller computed, and at the other ticks the errors that the plant measured.

    Raises LawError or PluginError as `Controller` does.
    """
    wire, controller, plant = session.settings.wire, session.controller, session.plant
    at, at_plant = session.at_controller, session.at_plant
    sent_as, received_as = _column(controller, at, "sent_as"), _column(controller, at, "received_as")
    by_plant = _column(plant, at_plant, "sent_as") == Sent.FRAME
    by_controller = (at_plant < 0) & (received_as == Received.FRAME)
    frames = np.concatenate([plant["measurement"][at_plant[by_plant]], controller["measurement"][at[by_controller]]])
    answered = np.isin(sent_as, (Sent.FRAME, Sent.SILENT)) | (session.acted >= 0)
    until = int(np.flatnonzero(answered)[-1]) + 1 if answered.any() else 0
    # what takes memory for a while comes before the table of all that is computed, 400 MB an hour
    measurements = codes_in(wire.measurement, frames)
    commands = codes_in(wire.command, controller["command"][at[sent_as == Sent.FRAME]])
    wall, sent, latency, there, back, offset_ns = _timed(session)
    volts = _voltages(session)
    table, widths, missed = _computed(session, progress)
    valid = ~np.isnan(table[:until, widths[0]])  # where q was measured
    judged: slice | Integers = slice(until)  # of most sessions all ticks are valid: a slice copies nothing
    if not valid.all():
        judged = np.flatnonzero(valid)
        for column in table.T:  # in place, one after the other
            column[: len(judged)] = column[judged]
    table = table[: int(valid.sum())]
    columns = [np.asarray(part) for part in np.split(table, np.cumsum(widths)[:-1], axis=1)]
    state, q, state_next, desired, rate, attitude_error, rate_error, unquantized = columns
    k, gains = session.k[judged], _gains(session, session.k[judged])
    commanded_at = slice(until) if answered[:until].all() else answered
    return Recomputed(
        ticks=Ticks(
            k, wall[judged], sent[judged], latency[judged], there[judged], back[judged], q, desired, rate,
            attitude_error, rate_error, volts[judged], unquantized, gains, state, state_next,
        ),
        answered=session.k[commanded_at],
        voltages=volts[commanded_at],
        missed=session.k[missed[missed < until]],
        unsent=(int((valid & ~(by_plant | by_controller)[:until]).sum()), int((sent_as == Sent.SILENT).sum())),
        measurements=measurements,
        commands=commands,
        offset_ns=offset_ns,
    )  # fmt: skip


def _computed(session: Session, progress: Progress | None) -> tuple[Array, list[int], Integers]:
    """Rows of the law's state, q, the state after, q_d, ω, ε̃, ω_e and u at each tick, of these widths.

    And the places of the ticks that the plant measured and the controller did not compute.
    """
    logged = LoggedController(session)
    outputs, before = logged.controller.outputs, len(logged.state_before)
    names = list(outputs)[: list(outputs).index("u") + 1]
    widths = [before, *(len(outputs[name]) for name in names)]
    columns = dict(zip(names, pairwise(np.cumsum(widths).tolist()), strict=True))
    table, row = np.full((len(session.k), sum(widths)), nan), np.asarray(logged.controller.row)[: sum(widths[1:])]
    u = slice(*columns["u"])

    places = np.full(len(session.controller), -1, dtype=np.int32)
    its = np.flatnonzero(session.at_controller >= 0)
    places[session.at_controller[its]] = its
    over = np.isin(_column(session.plant, session.at_plant, "sent_as"), (Sent.NONE, -1), invert=True)
    for i, answer in enumerate(logged.answers(progress)):
        if answer is not None and (place := places[i]) >= 0:
            over[place] = False
            if outputs["measured"][0]:
                table[place, :before] = logged.state_before
                table[place, before:] = row
                if not outputs["computed"][0]:
                    table[place, u] = nan
    missed = np.flatnonzero(over)
    _compute_missed(session, missed, {name: table[:, a:b] for name, (a, b) in columns.items()})
    table[missed, u] = nan
    return table, widths, missed


def _compute_missed(session: Session, missed: Integers, columns: dict[str, Array]) -> None:
    """Compute ticks that only the plant has, from the state that the controller had after its last one before."""
    logged = LoggedController(session)
    logged.resume(0)
    controller, plant = logged.controller, session.plant
    controller.leave_out_law()
    state = controller.last_valid["state_next"]
    state_kept = array("d", state)
    # a silent row repeats the levels of the frame before it, if no row between them is missing or left out
    framed = np.maximum.accumulate(np.where(plant["sent_as"] == Sent.FRAME, np.arange(len(plant)), -1))
    gaps = [gap.last_tick for gap in session.missing if gap.end == "plant" and gap.rows and gap.last_tick is not None]
    gaps_before = np.searchsorted(sorted([*gaps, *(one.last_tick for one in session.unknown)]), plant["session_tick"])
    framed[gaps_before[framed] != gaps_before] = -1
    known = np.where(np.isnan(columns["q"][:, 0]), -1, np.arange(len(session.k)))
    before, followed = np.maximum.accumulate(known), -1
    for place in missed.tolist():
        if (source := framed[session.at_plant[place]]) < 0:
            continue
        if before[place] != followed:
            followed = before[place]
            for name in ("q", "state_next"):
                controller.last_valid[name][:] = memoryview(columns[name][followed].copy())
            state_kept = array("d", state)
        tick = int(session.k[place])
        logged.change(tick)
        controller.tick(plant["measurement"][source].tobytes(), tick)
        if controller.outputs["measured"][0]:
            for name, column in columns.items():
                column[place] = controller.outputs[name]
            columns["state_next"][place] = state_kept
        state[:] = memoryview(state_kept)  # what the law would have done is not what it did


def _gains(session: Session, k: Integers) -> Array:
    """The gains in force at each tick k, one beside the other. Shape (n, gains)."""
    settings = session.settings
    gains = configured_gains(law_of(settings.law, settings.loop.period, settings.wire.actuators))
    known = not isinstance(settings.law, UnknownLawSettings)
    changes = [change for change in session.changes if known and change.gains is not None]
    sets = [list(gains.values())]
    for change in changes:
        assert change.gains is not None
        gains |= change.gains.named
        sets.append(list(gains.values()))
    flat = np.array([[value for gain in one for value in gain] for one in sets])
    which = np.searchsorted([change.tick for change in changes], k, side="right")
    if not len(which) or which[0] == which[-1]:  # a view of one row
        return np.broadcast_to(flat[which[0] if len(which) else 0], (len(which), flat.shape[1]))
    return np.asarray(flat[which])


def _voltages(session: Session) -> Array:
    """What was commanded at each tick [V]; NaN where nothing was. Shape (n, actuators)."""
    at, acted, wire = session.at_controller, session.acted, session.settings.wire
    volts = np.full((len(session.k), wire.actuators), nan)
    held, _ = commanded(session, wire, session.controller["sent_as"], session.controller["command"])
    answers = np.isin(_column(session.controller, at, "sent_as"), (Sent.FRAME, Sent.SILENT))
    volts[answers] = held[at[answers]]
    # where the controller's rows are missing
    others = (at < 0) & (_column(session.plant, acted, "received_as") == Sent.FRAME)
    volts[others] = levels(wire.voltage, codes_in(wire.command, session.plant["command"][acted[others]]))
    return volts


def commanded(
    session: Session, wire: WireSpec, sent_as: npt.NDArray[np.uint8], frames: npt.NDArray[np.void]
) -> tuple[Array, Flags]:
    """Voltages of the command in force at each of the controller's rows [V], and where one is known. Shapes (n, …).

    NaN is also a command without a valid value. A silent command repeats the last frame, or one of before a gap.
    """
    framed = sent_as == Sent.FRAME
    last = np.maximum.accumulate(np.where(framed, np.arange(len(framed)), -1))
    volts = levels(wire.voltage, codes_in(wire.command, frames))[last]
    known = last >= 0
    for i, state in session.states.items():
        if (sent := state.get("sent_codes")) is not None:
            until = i + int(np.argmax(np.append(framed[i:], True)))
            volts[i:until], known[i:until] = levels(wire.voltage, np.array(sent, np.float64)), True
    volts[~known] = nan
    return volts, known


# ── Frames ──


def codes_in(kind: FrameFormat, frames: npt.NDArray[np.void]) -> Codes:
    """Codes of well-formed frames, as `unpack` returns them, contiguous in memory per signal. Shape (n, codes)."""
    octets = np.ascontiguousarray(frames).view(np.uint8).reshape(len(frames), kind.size)
    codes: npt.NDArray[Any] = np.empty((len(kind.widths), len(frames)), np.float64 if None in kind.widths else np.int16)
    at = kind.first_bit
    for i, width in enumerate(kind.widths):
        size = width or 64
        bits = np.unpackbits(octets[:, at // 8 : (at + size + 7) // 8], axis=1)[:, at % 8 : at % 8 + size]
        if width is None:
            codes[i] = np.packbits(bits, axis=1).view(">f8")[:, 0]
        else:
            weights = 1 << np.arange(width)[::-1]
            weights[0] *= -1  # two's complement
            codes[i] = bits.astype(np.int16) @ weights.astype(np.int16)
        at += size
    return codes.T


def levels(signal: SignalSpec, codes: Codes) -> Array:
    """Level of each code, in the signal's unit; NaN for the code of "no valid value". Any shape."""
    table = _levels(signal)
    return np.asarray(codes) if table is None else table[codes.astype(np.intp)]  # a negative index counts from the end


@lru_cache(maxsize=8)
def _levels(signal: SignalSpec) -> Array | None:
    quantizer = signal.quantizer()
    return np.array(quantizer.levels) if isinstance(quantizer, CodedQuantizer) else None


def euler_deg(q: Array) -> Array:
    """Roll, pitch and yaw in degrees as `aeroloop.protocol.wire.attitude.to_euler` has them. Shape (n, 4) to (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.asarray(np.degrees(np.column_stack((roll, pitch, yaw))))


# ── Times ──


def clock_offset(forward: Array, backward: Array) -> Array:
    """The controller's monotonic clock minus the plant's at ticks in order [ns]; NaN before the first estimate.

        forward  = received by the controller − sent by the plant      = delay of the measurement + offset
        backward = received by the plant − sent by the controller      = delay of the command     − offset

    The offset is half their difference if both ways are equally fast. It is fitted by a straight line over windows,
    through the half with the shortest round trips, as queues only lengthen a delay. Shapes (n,), NaN for unknown times.
    """
    found, last_ns = np.empty(len(forward)), nan
    for part in np.array_split(np.arange(len(forward)), max(1, round(len(forward) / WINDOW))):
        found[part] = last_ns
        known = part[~np.isnan(forward[part] + backward[part])]
        if len(known) >= _LEAST:
            base = forward[known[0]]  # differences to it are small; times since boot would exceed a double's digits
            there, back = forward[known] - base, backward[known] + base
            quick = there + back <= np.median(there + back)
            at, offset = known[quick] - part[0], (there - back)[quick] / 2
            fit = np.polyfit(at, offset, 1 if at[-1] - at[0] >= WINDOW // 4 else 0)
            found[part] = base + np.polyval(fit, part - part[0])
            last_ns = found[part[-1]]
    return found


def _timed(session: Session) -> tuple[Integers, Integers, Array, Array, Array, tuple[float, float]]:
    """Wall time, time of sending, latency and both delays of each tick [ns], and `Recomputed.offset_ns`."""
    rows, plant = session.controller, session.plant
    at, at_plant, acted = session.at_controller, session.at_plant, session.acted
    sent = _column(plant, at_plant, "sent")
    wall = np.where(
        at_plant >= 0,
        sent + _column(plant, at_plant, "wall"),
        _column(rows, at, "received") + _column(rows, at, "wall"),
    )
    sent[_column(plant, at_plant, "sent_as") != Sent.FRAME] = -1
    if session.settings.loop.lockstep:
        unknown = np.broadcast_to(np.float64(nan), len(session.k))
        return wall, sent, unknown, unknown, unknown, (nan, nan)
    answered = np.where(_column(plant, acted, "received_as") == Sent.FRAME, _column(plant, acted, "received"), -1)
    received = np.where(_column(rows, at, "received_as") == Received.FRAME, _column(rows, at, "received"), -1)
    forward, backward = _since(sent, received), _since(_column(rows, at, "sent"), answered)
    offset = clock_offset(forward, backward)
    known = offset[~np.isnan(offset)]
    ends = (float(known[0]), float(known[-1])) if len(known) else (nan, nan)
    return wall, sent, _since(sent, answered), forward - offset, backward + offset, ends


def _column(table: Table, places: Places, name: str) -> npt.NDArray[Any]:
    """A column's values at places of a table; −1 where the place is −1. Shape (n,)."""
    values = table[name]
    kind = np.int16 if values.itemsize == 1 else np.int64
    return np.append(values.astype(kind), kind(-1))[places]


def _since(begin: Integers, end: Integers) -> Array:
    """How long after one time another was [ns]; NaN where one is unknown. Shape (n,)."""
    return np.where((begin >= 0) & (end >= 0), (end - begin).astype(np.float64), nan)
