"""Replay of both ends from a log's traces, compared byte for byte.

The controller is sans-I/O and its rows hold all its inputs, so a loop over them must give the same commands: which were
sent, which were silent, and every bit of them. The emulated plant is replayed from its own rows
(plant_emulator/hosts/trace.py). With another configuration, replay computes what would have been commanded instead;
the log's plant does not respond to that, so it is no simulation: service/lab/fork.py is one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.hosts.trace import PlantReplay, PlantReplayed, why_not
from aeroloop.plant_emulator.plant import PlantError
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.trace import ENDS, End, Sent
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings, from_description, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.logs.frames import Direction, differences
from aeroloop.service.logs.recording import INDEXING, Progress, Recording, ReviewError
from aeroloop.service.logs.session import Missing, SessionKey, Source, Unknown
from aeroloop.service.logs.ticks import LoggedController


class AnotherWireError(ReviewError):
    """The configuration has a wire whose frames are not those of the log."""


class TickDifference(BaseModel, frozen=True):
    """The first row whose computed command differs from the logged one."""

    tick: int
    time_s: float = Field(description="on the law's clock [s]")
    logged: str = Field(description="the command frame, in hexadecimal; `silent` or `none` where none was sent")
    computed: str
    signals: list[str] = Field(default=[], description="signals that differ: both values, and how many steps apart")


def tick_difference(
    settings: Settings, direction: Direction, tick: int, logged: tuple[int, np.void], computed: tuple[int, np.void]
) -> TickDifference:
    """Two frames of a tick that differ, each with how it was sent (`Sent`, −1 where the row is missing)."""
    (sent, frame), (other_sent, other_frame) = logged, computed
    both = sent == other_sent == Sent.FRAME
    signals = differences(settings.wire, direction, frame.tobytes(), other_frame.tobytes()) if both else []
    return TickDifference(
        tick=tick,
        time_s=round(tick * settings.loop.period, 9),
        logged=_in_hex(sent, frame),
        computed=_in_hex(other_sent, other_frame),
        signals=[*map(str, signals)],
    )


class SessionReplay(BaseModel, frozen=True):
    """Result of replaying one session's controller."""

    vehicle: str
    session: str
    first_tick: int | None = Field(description="where the replay began; null without any row")
    ticks: int = Field(description="ticks that were computed again")
    differ: int = Field(description="rows whose command is not the same")
    first_difference: TickDifference | None
    digest: str = Field(description="SHA-256 of the computed commands and of which were silent")


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
    plants: list[PlantReplayed] = Field(description="the plant's processes with rows, in the order of recording")
    missing: list[Missing] = Field(description="rows of the ends asked for that the log lacks")
    damages: list[str] = Field(description="unreadable parts of the log")
    unseen: dict[End, list[str]] = Field(
        description="by end that was asked for: what was not compared, since the log lacks it, is cut or damaged, or "
        "cannot be computed again from it"
    )
    failed: dict[End, str] = Field(
        default={}, description="by end: why rows that another installation might compute again cannot be here"
    )
    others: list[str] = Field(
        default=[],
        description="sessions that are not judged: of other vehicles, or of processes of which no session has rows of "
        "both ends",
    )

    @property
    def differs(self) -> bool:
        """Whether any end differs."""
        return any(end is not None and end.differ > 0 for end in (self.controller, self.plant))

    @property
    def first_differences(self) -> list[str]:
        """Where each session's controller and each process of the plant first differ, a line each."""
        lines = list[str]()
        for session in self.sessions:
            if (one := session.first_difference) is not None:
                what = "; ".join(one.signals) or f"{one.logged} and {one.computed}"
                lines.append(f"{session.session} at tick {one.tick} ({one.time_s:g} s), logged and computed: {what}")
        for plant in self.plants:
            if (other := plant.first_difference) is not None:
                what = "; ".join(other.signals) or f"{other.field} {other.logged} and {other.computed}"
                where = f"{other.session} at tick {other.session_tick} of the plant"
                lines.append(f"{where}, logged and computed: {what}")
        return lines

    @property
    def complete(self) -> bool:
        """Whether every row of the ends asked for was compared, of all that were written."""
        return not any(self.unseen.values())


class Answering:
    """How rows of a controller are answered again: by the controller itself. A subclass may compute them otherwise."""

    made_by: type[Controller] = Controller

    def answers(self, logged: LoggedController, progress: Progress | None) -> Iterable[bytes | None]:
        """As `LoggedController.answers`."""
        return logged.answers(progress)


def replay(
    paths: Sequence[Path],
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
    ends: Collection[End] = ENDS,
    answering: Answering | None = None,
    vehicle: str | None = None,
) -> Replay:
    """Replay the sessions of a run's vehicle, the longest session's if None, as of `Recording.judged`.

    With overrides, `section.key=value`, the controller is computed with another law instead, and the plant is not. An
    override of the gains or of the reference replaces every logged change of them.

    Raises:
        ReviewError: It cannot be read, or has no configuration of any end.
        ConfigError: An override is wrong.
    """
    recording = Recording(paths, progress)
    judged = recording.judged(recording.choose(vehicle=vehicle))
    reasons: dict[str, str] = {end: "only the other end was replayed" for end in ENDS if end not in ends}
    unseen = dict[End, list[str]]()
    sessions, plants = list[SessionReplay](), list[PlantReplayed]()
    failed: dict[SessionKey, AeroloopError] = {}
    failures: dict[End, str] = {}
    if "controller" in ends:
        for which in (which for which in judged.sessions if recording.extents[which].rows["controller"]):
            try:
                sessions.append(_replay_session(recording, which, overrides, progress, answering or Answering()))
            except AeroloopError as error:
                if overrides:
                    raise
                failed[which] = error
        unseen["controller"] = [str(one) for one in judged.unknown]
        if failed:
            failures["controller"] = "; ".join(f"{'/'.join(which)}: {error}" for which, error in failed.items())
            reasons["controller"] = failures["controller"]
            left = sum(recording.extents[which].rows["controller"] for which in failed)
            unseen["controller"].append(f"{left} of the controller's rows: {reasons['controller']}")
        elif not sessions:
            reasons["controller"] = "the log has no trace of a controller"
    if overrides:
        reasons["plant"] = "the plant of a log does not follow another configuration"
    elif "plant" in ends:
        plants, reason, unseen["plant"] = _replay_plants(recording, judged.processes, failures, progress)
        if reason is not None:
            reasons["plant"] = reason
    if failed and not (sessions or plants):
        raise next(iter(failed.values()))
    missing = [gap for gap in judged.missing if gap.end in ends]
    for end, its in unseen.items():
        lacks = [f"{gap}, which the log lacks" for gap in missing if gap.end == end and gap.rows]
        unseen[end] = [*lacks, *its, *judged.damages]
    return Replay(
        controller=_sum(sessions),
        plant=_sum([result for result in plants if result.ticks]),
        reasons=reasons,
        unknown=judged.unknown,
        sessions=sessions,
        plants=plants,
        missing=missing,
        damages=recording.unread,
        unseen=unseen,
        failed=failures,
        others=judged.others,
    )


def _sum(parts: Sequence[SessionReplay] | Sequence[PlantReplayed]) -> EndReplay | None:
    if not parts:
        return None
    return EndReplay(ticks=sum(part.ticks for part in parts), differ=sum(part.differ for part in parts))


def _replay_session(
    recording: Recording, which: SessionKey, overrides: Sequence[str], progress: Progress | None, answering: Answering
) -> SessionReplay:
    """Replay a session's controller. Raises AeroloopError if that cannot be."""
    settings = load_over(recording.settings(which), overrides)
    session = recording.session(which)
    ignored = [override.partition("=")[0].strip() for override in overrides]
    if settings.law.kind == session.settings.law.kind:
        ignored = [key for key in ignored if key != "law.kind"]
    logged = LoggedController(session, settings, ignored=ignored, resumes=not overrides, made_by=answering.made_by)
    rows, wire = session.controller, settings.wire
    if wire.measurement.widths != session.settings.wire.measurement.widths:
        raise AnotherWireError("its measurements are frames of another wire, so no command can be computed from them")
    sent_as, frames = bytearray(), bytearray()

    def share(done: float) -> None:
        if progress is not None:
            progress(INDEXING + (1 - INDEXING) / 2 * done)

    for answer in answering.answers(logged, share):
        sent_as.append(Sent.NONE if answer is None else Sent.FRAME if answer else Sent.SILENT)
        frames += answer or bytes(wire.command.size)

    computed_as, computed = np.frombuffer(sent_as, np.uint8), np.frombuffer(frames, f"V{wire.command.size}")
    if wire.command.size == session.settings.wire.command.size:
        differ = (computed_as != rows["sent_as"]) | (computed != rows["command"])
    else:
        differ = (computed_as != rows["sent_as"]) | (computed_as == Sent.FRAME)
    difference, ticks = None, int((computed_as != Sent.NONE).sum())
    if differ.any():
        first = int(np.argmax(differ))
        logged_as = int(rows["sent_as"][first]), rows["command"][first]
        computed_so = int(computed_as[first]), computed[first]
        difference = tick_difference(session.settings, "command", int(rows["tick"][first]), logged_as, computed_so)
    return SessionReplay(
        vehicle=which[0],
        session=which[1],
        first_tick=int(rows["tick"][0]) if len(rows) else None,
        ticks=ticks,
        differ=int(differ.sum()),
        first_difference=difference,
        digest=sha256(sent_as + frames).hexdigest(),
    )


def _in_hex(sent_as: int, frame: np.void) -> str:
    return frame.tobytes().hex() if sent_as == Sent.FRAME else "missing" if sent_as < 0 else Sent(sent_as).name.lower()


def _with_signals(result: PlantReplayed, wire: WireSpec) -> PlantReplayed:
    """A result that says which signals of a measurement differ."""
    first = result.first_difference
    if first is None or first.field != "measurement" or not (first.logged and first.computed):
        return result
    frames = bytes.fromhex(first.logged), bytes.fromhex(first.computed)
    signals = [*map(str, differences(wire, "measurement", *frames))]
    return result.model_copy(update={"first_difference": first.model_copy(update={"signals": signals})})


def _replay_plants(
    recording: Recording, processes: Collection[Source], failures: dict[End, str], progress: Progress | None
) -> tuple[list[PlantReplayed], str | None, list[str]]:
    """Replay these processes of plants, each from its first row with the configuration that it started with.

    Returns the result of each process, the reason if there is none or one ends early, and which rows are not compared.
    A class that cannot be had is put into `failures`.
    """
    results, reasons, unseen = list[PlantReplayed](), list[str](), list[str]()
    forked = recording.metadata.get("fork")
    if forked is not None:
        tick = forked.get("tick", "?")
        return [], f"a fork's plant begins in flight, at tick {tick}: only the log that was forked has its state", []
    plants = [plant for plant in recording.plants() if plant[0] in processes]
    done, total = 0, max(1, sum(batch.header.rows for *_, batches in plants for batch in batches))
    for source, description, batches in plants:
        left, reason = sum(batch.header.rows for batch in batches), None
        if description is None:
            reason = f"the log has no description of {source.vehicle}'s plant"
        else:
            its = from_description(description.config)
            try:
                if (why := why_not(its.plant)) is not None:  # no log of it could be compared
                    reasons.append(why)
                    continue
                one = PlantReplay(its.loop, its.wire, its.plant)
            except (PlantError, PluginError) as error:
                failures["plant"] = reason = str(error)
            else:
                for batch in batches:
                    one.feed(batch)
                    done += batch.header.rows
                    if progress is not None:
                        progress((1 + INDEXING) / 2 + (1 - INDEXING) / 2 * done / total)
                results.append(result := _with_signals(one.result(), its.wire))
                left, reason = left - result.ticks, result.stopped
        if reason is not None:
            reasons.append(reason)
        if left > 0:
            unseen.append(f"{left} of the plant's rows: {reason or 'a batch of them cannot be read'}")
    none = None if results else "the log has no trace of a plant"
    return results, next(iter(reasons), none), unseen
