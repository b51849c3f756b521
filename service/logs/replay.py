"""Replay of both ends from a log's traces, compared byte for byte.

The controller is sans-I/O and its rows hold all its inputs, so the same rows must give the same commands: which were
sent, which were silent, and every bit of them. The emulated plant is replayed from its own rows
(plant_emulator/hosts/replay.py). With another configuration, replay computes what would have been commanded instead;
the log's plant does not respond to that, so it is no simulation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import partial
from math import sqrt
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from aeroloop.plant_emulator.hosts.replay import PlantReplay, PlantReplayed, why_not
from aeroloop.plant_emulator.plant import PlantError
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import ENDS, End, Sent, read_batch
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.config import Settings, from_description, load_over
from aeroloop.service.control.controller import Codes
from aeroloop.service.figures import added, squares
from aeroloop.service.logs.codes import codes_in, frames_of, levels
from aeroloop.service.logs.evaluate import Evaluator, held_codes
from aeroloop.service.logs.files import Progress, ReviewError
from aeroloop.service.logs.in_force import Unknown
from aeroloop.service.logs.prelude import read_description
from aeroloop.service.logs.runs import Block, Run, Taker, TraceJoin
from aeroloop.service.logs.traces import Array, Arrived, Missing, SessionKey, Source


class TickDifference(BaseModel, frozen=True):
    """The first row whose computed command differs from the logged one."""

    tick: int
    time_s: float = Field(description="on the law's clock [s]")
    logged: str = Field(description="the command frame, in hexadecimal; `silent` or `none` where none was sent")
    computed: str


class SessionReplay(BaseModel, frozen=True):
    """Result of replaying one session's controller."""

    vehicle: str
    session: str
    first_tick: int | None = Field(description="where the replay began; null without any row")
    ticks: int = Field(description="ticks that were computed again")
    differ: int = Field(description="rows whose command is not the same")
    first_difference: TickDifference | None
    rms_v: float | None = Field(description="root mean square of the difference between computed and logged levels [V]")
    max_v: float | None = Field(description="largest difference of a motor [V]")
    u_total_logged: float = Field(description="∫ uᵀu dt of the commands compared [V²·s]")
    u_total_computed: float


class EndReplay(BaseModel, frozen=True):
    """Result of replaying one end, over all sessions."""

    ticks: int = Field(description="ticks that were computed again")
    differ: int = Field(description="how many of them differ in any bit")


class Replay(BaseModel, frozen=True):
    """Result of replaying a run."""

    controller: EndReplay | None = Field(description="null: it could not be replayed, see `reasons`")
    plant: EndReplay | None
    reasons: dict[str, str] = Field(description="why an end could not be replayed, or not to its end")
    unknown: list[Unknown] = Field(description="ticks of which the log does not hold what was in force")
    sessions: list[SessionReplay]
    plants: list[PlantReplayed] = Field(description="the plant's processes, in the order of recording")
    missing: list[Missing] = Field(description="rows of the ends asked for that the log lacks")
    damages: list[str] = Field(description="unreadable parts of the log")
    unseen: dict[End, list[str]] = Field(
        description="by end that was asked for: what was not compared, since the log lacks it, is cut or damaged, or "
        "cannot be computed again from it"
    )

    @property
    def differs(self) -> bool:
        """Whether any end differs."""
        return any(end is not None and end.differ > 0 for end in (self.controller, self.plant))

    @property
    def complete(self) -> bool:
        """Whether every row of the ends asked for was compared, of all that were written."""
        return not any(self.unseen.values())


class Replayer:
    """Replays one session's controller by an evaluator, whose settings these are; `rows` counts the rows compared."""

    def __init__(self, which: SessionKey, evaluator: Evaluator, settings: Settings) -> None:
        self._which = which
        self._evaluator = evaluator
        self._wire, self._period = settings.wire, settings.loop.period
        self.rows = 0
        self._held: Codes | None = None  # codes of the last command sent
        self._first: TickDifference | None = None
        self._first_tick: int | None = None
        self._ticks = self._differ = 0
        self._square = self._largest = self._logged = self._computed = 0.0

    def take(self, block: Block) -> None:
        """Replay the next block."""
        rows, wire, evaluator = block.controller, self._wire, self._evaluator
        used = evaluator.used(block)
        if not rows:
            return
        if block.state is not None and (sent := block.state.get("sent_codes")) is not None:
            self._held = tuple(sent)
        commands = evaluator.commands(used, evaluator.compute(used))
        n = len(rows["tick"])
        sent_as = np.full(n, int(Sent.NONE), dtype=np.uint8)
        sent_as[used.rows] = np.where(commands.sent, int(Sent.FRAME), int(Sent.SILENT))
        counters = used.k[commands.sent] % wire.measurement.counters
        frames = np.zeros((n, wire.command.size), dtype=np.uint8)
        frames[used.rows[commands.sent]] = frames_of(wire.command, counters, commands.codes[commands.sent])
        logged = np.ascontiguousarray(rows["command"]).view(np.uint8).reshape(n, -1)
        differ = (rows["sent_as"] != sent_as) | (logged != frames).any(axis=1)
        if differ.any() and self._first is None:
            i = int(np.argmax(differ))
            tick, was, now = int(rows["tick"][i]), _text(rows["sent_as"][i], logged[i]), _text(sent_as[i], frames[i])
            self._first = TickDifference(tick=tick, time_s=round(tick * self._period, 9), logged=was, computed=now)
        self._differ += int(differ.sum())
        self._ticks += len(used.k)
        self.rows += n
        if self._first_tick is None:
            self._first_tick = int(rows["tick"][0])
        framed = rows["sent_as"] == Sent.FRAME
        held, self._held = held_codes(framed, codes_in(wire.command, rows["command"][framed]), self._held)
        self._compare(held[used.rows], commands.codes)

    def _compare(self, logged: Array, computed: Array) -> None:
        """Compare voltages."""
        signal = self._wire.voltage
        known = ~np.isnan(logged).all(axis=1) if signal.bits else np.ones(len(logged), dtype=np.bool_)
        if not known.any():
            return
        logged, computed = _volts(signal, logged[known]), _volts(signal, computed[known])
        self._logged = added(self._logged, squares(logged))
        self._computed = added(self._computed, squares(computed))
        self._square = added(self._square, squares(computed - logged))
        self._largest = max(self._largest, float(np.abs(computed - logged).max()))

    def result(self) -> SessionReplay:
        """Result of all blocks so far."""
        return SessionReplay(
            vehicle=self._which[0],
            session=self._which[1],
            first_tick=self._first_tick,
            ticks=self._ticks,
            differ=self._differ,
            first_difference=self._first,
            rms_v=sqrt(self._square / self._ticks) if self._ticks else None,
            max_v=self._largest if self._ticks else None,
            u_total_logged=self._logged * self._period,
            u_total_computed=self._computed * self._period,
        )


def _text(sent_as: int, frame: Array) -> str:
    return frame.tobytes().hex() if sent_as == Sent.FRAME else Sent(int(sent_as)).name.lower()


def _volts(signal: SignalSpec, codes: Array) -> Array:
    """Voltages that a plant applies; 0 V for a code of no valid value."""
    volts = levels(signal, codes)
    return np.where(np.isnan(volts), 0.0, volts)


class Plants:
    """Replays the plants of a run, each process from its first row."""

    def __init__(self, run: Run) -> None:
        self._descriptions = dict(run.files.first_descriptions)
        self._replays: dict[Source, PlantReplay] = {}
        self._reasons: dict[Source, str] = {}  # of those that cannot be replayed
        self._rows = Counter[Source]()  # of those that are to be compared

    def route(self, address: Address) -> Taker | None:
        """Takes descriptions: a process is replayed with the configuration that it started with."""
        return partial(self._description, address) if address.topic.name == "description" else None

    def take(self, arrived: Arrived) -> None:
        """The next batch of a plant."""
        source = arrived.source
        self._rows[source] += arrived.header.rows
        if source not in self._replays:
            description = self._descriptions.get((source.vehicle, "plant"))
            if description is None:
                self._reasons[source] = f"the log has no description of {source.vehicle}'s plant"
                return
            settings = from_description(description.config)
            if (why := why_not(settings.plant)) is not None:
                self._reasons[source] = why
                del self._rows[source]
                return
            try:
                self._replays[source] = PlantReplay(settings.loop, settings.wire, settings.plant)
            except PlantError as error:
                self._reasons[source] = str(error)
                return
        if (batch := read_batch(arrived.payload)) is not None:
            self._replays[source].feed(batch)

    def results(self) -> tuple[list[PlantReplayed], str | None, list[str]]:
        """Result of each process, the reason if there is none or one ends early, and which rows are not compared."""
        results = {source: replay.result() for source, replay in self._replays.items()}
        reasons = self._reasons | {source: one.stopped for source, one in results.items() if one.stopped is not None}
        left = {
            source: rows - (results[source].ticks if source in results else 0) for source, rows in self._rows.items()
        }
        cut = "a batch of them cannot be read"
        unseen = [
            f"{rows} of the plant's rows: {reasons.get(source, cut)}" for source, rows in left.items() if rows > 0
        ]
        none = None if results else "the log has no trace of a plant"
        return list(results.values()), next(iter(reasons.values()), none), unseen

    def _description(self, address: Address, payload: bytes, _: int) -> None:
        with suppress(ValueError):  # malformed: the files' prelude has counted it
            description = read_description(payload, address)
            self._descriptions[description.vehicle, description.role] = description


def replay(
    paths: Sequence[Path], overrides: Sequence[str] = (), progress: Progress | None = None, ends: Collection[End] = ENDS
) -> Replay:
    """Replay every session of a run.

    Args:
        paths: Logs, folders of logs, or a rotated run.
        overrides: `section.key=value`, to compute with another law instead of the logged one. An override of the gains
            or of the reference replaces every logged change of them. The plant is not replayed then.
        progress: Called repeatedly with the share done, 0…1.
        ends: Ends to replay; the plant takes most of the time.

    Raises:
        ReviewError: It cannot be read, or has no configuration of any end.
        ConfigError: An override is wrong.
    """
    try:
        run = Run(paths, progress)
        run.choose()  # raises where there is no session
        return _replayed(run, overrides, ends)
    except ValidationError as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None


def _replayed(run: Run, overrides: Sequence[str], ends: Collection[End]) -> Replay:
    own_gains = any(override.startswith("law.") for override in overrides)
    own_reference = any(override.startswith("reference") for override in overrides)
    replayers: dict[SessionKey, Replayer] = {}
    joins: dict[SessionKey, TraceJoin] = {}
    failed: dict[SessionKey, AeroloopError] = {}
    plants = Plants(run)
    for arrived in run.batches(plants.route):
        source = arrived.source
        which = source.vehicle, arrived.header.session
        if source.end == "plant":
            if "plant" in ends and not overrides:
                plants.take(arrived)
            continue
        if which not in run.extents or "controller" not in ends or which in failed:
            continue
        if which not in joins:
            try:
                settings = load_over(run.settings(which), overrides)
                evaluator = Evaluator(settings, own_gains=own_gains, own_reference=own_reference, resumes=not overrides)
            except AeroloopError as error:
                if overrides:
                    raise
                failed[which] = error
                continue
            replayers[which] = Replayer(which, evaluator, settings)
            joins[which] = run.join(which, alone=True)
        if joins[which].add(arrived):
            for block in joins[which].blocks():
                replayers[which].take(block)
    for which, join in joins.items():
        for block in join.blocks(finished=True):
            replayers[which].take(block)
    sessions = [replayer.result() for replayer in replayers.values()]
    results, reason, plants_unseen = plants.results()
    if failed and not (sessions or results):
        raise next(iter(failed.values()))
    reasons = {} if sessions else {"controller": "the log has no trace of a controller"}
    if failed:
        reasons["controller"] = "; ".join(f"{'/'.join(which)}: {error}" for which, error in failed.items())
    left = sum(extent.rows["controller"] for extent in run.extents.values()) - sum(
        one.rows for one in replayers.values()
    )
    if overrides:
        reason = "the plant of a log does not follow another configuration"
    if reason is not None:
        reasons["plant"] = reason
    reasons |= {end: "only the other end was replayed" for end in ENDS if end not in ends}
    missing = [gap for gap in run.missing if gap.end in ends]
    not_compared: dict[End, list[str]] = {
        "controller": [
            *map(str, run.unknown),
            *([f"{left} of the controller's rows: {reasons['controller']}"] if left and failed else []),
        ],
        "plant": plants_unseen,
    }
    unseen = {
        end: [
            *(f"{gap}, which the log lacks" for gap in missing if gap.end == end and gap.rows),
            *its,
            *run.files.damaged,
        ]
        for end, its in not_compared.items()
        if end in ends and not (overrides and end == "plant")
    }
    return Replay(
        controller=_sum(sessions),
        plant=_sum([result for result in results if result.ticks]),
        reasons=reasons,
        unknown=run.unknown,
        sessions=sessions,
        plants=results,
        missing=missing,
        damages=run.files.unread,
        unseen=unseen,
    )


def _sum(parts: Sequence[SessionReplay] | Sequence[PlantReplayed]) -> EndReplay | None:
    if not parts:
        return None
    return EndReplay(ticks=sum(part.ticks for part in parts), differ=sum(part.differ for part in parts))
