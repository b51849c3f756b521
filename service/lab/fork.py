"""Fork: a recorded run, continued in lockstep from one of its instants with something changed.

Both ends are computed again up to the plant's measurement of that tick, from what they received; from there on the loop
closes in this process. What came from outside, such as an operator's later gains, references, faults and stop, acts as
recorded unless the fork replaces it; releases and lost sessions do not. So a fork with no change repeats a lockstep
log, and a real-time one up to the first tick at which the network lost or delayed a frame.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.trace import PlantReplay, cut, plant_row
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.operator import Change, Gains, in_force
from aeroloop.protocol.messages.trace import (
    ENDS,
    ControllerRow,
    End,
    PlantChange,
    PlantRow,
    Received,
    Sent,
    TraceWriter,
    record_json,
)
from aeroloop.protocol.transport.history import Delivery
from aeroloop.protocol.transport.link import Arrival
from aeroloop.service.config import Settings, from_description, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.registry import gains_of, law_class, with_gains
from aeroloop.service.control.motion import Approach, shortest
from aeroloop.service.control.reference import Limits, Trajectory
from aeroloop.service.figures import Figures
from aeroloop.service.lab.lockstep import LockstepLoop
from aeroloop.service.logs.frames import Direction
from aeroloop.service.logs.outputs import OutputError
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.replay import TickDifference, tick_difference
from aeroloop.service.logs.session import Integers, Session
from aeroloop.service.logs.ticks import LoggedController, Ticks
from aeroloop.service.recording.rolling import LogFile
from aeroloop.service.review.review import Review, read

REPLAYED: Final = 0.6  # share of the progress when both ends have been computed again
FOLLOWED: Final = ("stop", "inject")  # changes at the plant that come from outside of the loop


class ForkError(AeroloopError):
    """A log cannot be forked so; one line that says why and what to do."""


class Parting(TickDifference, frozen=True):
    """The first tick at which the fork and the recorded run differ; `computed` is the fork's."""

    end: End


@dataclass(frozen=True)
class Fork:
    """A fork, judged as any log is, beside the same span of the recorded run; None where nothing was recorded then."""

    tick: int
    at_s: float
    changed: list[str]  # what is different from the recorded run, a line each
    parts: Parting | None  # None: it repeats the recorded run
    compared: int  # ticks from `tick` on that both have
    ended: str | None  # why it ended before its time
    differed: str | None  # where the plant, computed again, already differed before the fork
    log: Path | None
    forked: Review
    recorded: Review | None

    @property
    def figures(self) -> Figures:
        """Figures of the fork."""
        return self.forked.figures

    @property
    def ticks(self) -> Ticks:
        """The fork's ticks in columns."""
        return self.forked.ticks


def fork(
    paths: Sequence[Path],
    at: int | float,
    *,
    session: str | None = None,
    vehicle: str | None = None,
    overrides: Sequence[str] = (),
    gains: Gains | None = None,
    faults: Sequence[str] = (),
    duration_s: float | None = None,
    log: Path | None = None,
    progress: Progress | None = None,
) -> Fork:
    """Continue a session of a run from an instant.

    Args:
        paths: Logs, folders, or the files of a rotated run.
        at: The tick, as an int, or a time on the law's clock [s].
        session: As of `Recording.choose`.
        vehicle: Likewise.
        overrides: `section.key=value`. From the session's first tick on anything may change; from a later one law,
            reference and, of an emulated body, its mechanics, wind and sensors.
        gains: Gains from that tick on, whatever was recorded later.
        faults: Faults to inject after that tick's measurement, as `op inject` would.
        duration_s: Length of the fork [s]; to the end of the recorded session if None.
        log: New file for the fork's ticks; None for none.
        progress: Called with the share done.

    Raises:
        ForkError: It cannot be forked so.
        AeroloopError: The log cannot be read, or an override or a fault is wrong.
    """
    report = progress or (lambda _: None)
    recording = Recording(paths, lambda share: report(share / 2))
    which = recording.choose(session, vehicle)
    recorded = recording.session(which)
    period = recorded.settings.loop.period
    tick = at if isinstance(at, int) else round(at / period)
    last = recorded.extent.last["controller"]
    if not 0 <= tick <= last:
        raise ForkError(f"the session has ticks 0 to {last}, up to {last * period:g} s, and none {tick}")
    settings = load_over(recorded.settings, overrides) if overrides else recorded.settings
    until = last if duration_s is None else tick + max(1, round(duration_s / settings.loop.period)) - 1
    plant, later = _plant_at(recording, recorded, settings, tick, report)
    its = _Changes(recorded, settings, tick, overrides, gains)
    if faults:
        plant.endpoint.inject([Fault.parse(text) for text in faults])
    differed, where = plant.result().first_difference, None
    if differed is not None:
        where = f"the plant, computed again, differs from the log from tick {differed.session_tick} on"
    with ExitStack() as stack:
        out = log or Path(stack.enter_context(TemporaryDirectory())) / f"{paths[0].stem or 'log'}-fork.mcap"
        ended = _run(out, recording, recorded, its, plant, later, until, lambda share: report(REPLAYED + 0.3 * share))
        forked = read(out)
        found = Recording([out]).session(which)
        end_s = until * settings.loop.period
        both = recorded.settings.loop.period == settings.loop.period and recorded.settings.wire == settings.wire
        parts, compared = _parting(recorded, found, tick) if both else (None, 0)
        known = read(*paths, session="/".join(which), since_s=tick * period, until_s=end_s + period / 2)
    report(1.0)
    changed = [
        *overrides,
        *(f"{name} = {list(gain)}" for name, gain in (gains.named if gains else {}).items()),
        *faults,
    ]
    return Fork(tick, tick * period, changed, parts, compared, ended, where, log, forked, known)


# ── both ends at the instant ──


def _plant_at(
    recording: Recording, recorded: Session, settings: Settings, tick: int, report: Progress
) -> tuple[PlantReplay, deque[PlantChange]]:
    """The plant end after its measurement of a tick, and the changes after it that came from outside."""
    vehicle, session = recorded.which
    processes = [
        (description, batches)
        for source, description, batches in recording.plants()
        if source.vehicle == vehicle
        if any(batch.header.session == session and batch.header.rows for batch in batches)
    ]
    if not processes or (description := processes[0][0]) is None:
        raise ForkError(f"the log has no trace or no description of {vehicle}'s plant in {session}")
    batches = processes[0][1]
    was = from_description(description.config)
    another = [
        name for name in ("loop", "wire", "plant") if getattr(settings, name) != getattr(recorded.settings, name)
    ]
    try:
        if another and not tick:
            return _plant_anew(batches, session, settings), deque()
        if wrong := [name for name in another if name != "plant"]:
            raise ForkError(f"{wrong[0]}.* holds from the session's start: fork it --at 0")
        plant = PlantReplay(was.loop, was.wire, was.plant)
    except ValueError as error:
        raise ForkError(str(error)) from None
    left, later = sum(batch.header.rows for batch in batches), deque[PlantChange]()
    rows, found = max(1, left), False
    for batch in batches:
        ticks = batch.columns["session_tick"]
        wanted = int(np.searchsorted(ticks, tick, "right")) if batch.header.session == session else len(ticks)
        if not found:
            found = batch.header.session == session and wanted > 0 and int(ticks[wanted - 1]) == tick
            plant.feed(cut(batch, wanted) if found else batch)
            left -= batch.header.rows
            report(0.5 + (REPLAYED - 0.5) * (1 - left / rows))
        if found:
            later += [change for change in batch.tail.operations if change.kind in FOLLOWED]
    if not found or (stopped := plant.result().stopped) is not None:
        raise ForkError(f"the plant is not known at tick {tick}: {stopped if found else 'the log lacks its row'}")
    ticked = plant.endpoint.ticked
    if another:
        try:
            plant.endpoint.plant = settings.plant.continued(plant.endpoint.plant, was.plant, was.loop.period)
        except ValueError as error:
            raise ForkError(f"{error}: fork it --at 0") from None
    return plant, deque(change for change in later if change.tick >= ticked)


def _plant_anew(batches: Sequence[Any], session: str, settings: Settings) -> PlantReplay:
    """A plant end with other settings at the first measurement of a session, which must be its first."""
    plant = PlantReplay(settings.loop, settings.wire, settings.plant)
    for batch in batches:
        for change in batch.tail.operations:
            if change.claim is None:
                plant.apply(change)
            elif change.claim.session == session:
                theirs = {
                    "wire": settings.wire,
                    "period_ns": settings.loop.period_ns,
                    "lockstep": settings.loop.lockstep,
                }
                claim = change.claim.model_copy(update={**theirs, "auto_arm": True})
                plant.apply(change.model_copy(update={"claim": claim}))
                measurement = plant.endpoint.tick(None, plant.endpoint.ticked + 1)
                plant.last = plant_row(plant.endpoint, measurement, None, 0)
                return plant
        if batch.header.rows:
            raise ForkError(
                "another plant, wire or loop holds from the plant's start, and the session is not its first"
            )
    raise ForkError("the log lacks the session's claim")


class _Changes:
    """The controller at an instant, and the changes of gains and reference that it follows from there on."""

    def __init__(
        self, recorded: Session, settings: Settings, tick: int, overrides: Sequence[str], gains: Gains | None
    ) -> None:
        self.settings, self.tick, self.name = settings, tick, recorded.which[1]
        law, before = law_class(settings.law), recorded.settings
        keys = [override.partition("=")[0].strip() for override in overrides]
        given = {name: getattr(settings.law, name) for name in law.gains if f"law.{name}" in keys}
        given |= gains.named if gains else {}
        replaced: dict[str, None] = {}
        if given:
            with_gains(settings.law, Gains.model_validate(given))  # raises LawError
            replaced["gains"] = None
        follows = any(key.startswith("reference") for key in keys)
        if follows:
            replaced["reference"] = None
        past = [change for change in recorded.changes if change.tick <= tick]
        future = [change.model_copy(update=replaced) for change in recorded.changes if change.tick > tick]
        if settings.law.kind != before.law.kind:
            given = gains_of(settings.law).named | given
            past, future = ([each.model_copy(update={"gains": None}) for each in some] for some in (past, future))

        self.controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        for change in past:
            self.controller.apply(change)
        if tick:
            logged, rows = LoggedController(recorded), recorded.controller
            later = (rows["tick"] >= tick) & np.isin(rows["received_as"], (Received.FRAME, Received.SILENT))
            for _ in islice(logged.answers(), int(np.argmax(np.append(later, True)))):
                pass
            self.controller.restore(logged.controller.state)
        own = Change(session=self.name, tick=tick, gains=Gains.model_validate(given) if given else None)
        if follows:
            approach = self._approach(settings) if tick else Approach()
            own = own.model_copy(update={"reference": settings.reference, **approach._asdict()})
        if given or follows:
            self.controller.apply(own)
            past = [*past, own]
        self.in_force, self._later = in_force(past), deque(future)
        self.applied: list[Change] = []  # since they were last recorded

    def _approach(self, settings: Settings) -> Approach:
        """As `op track` approaches a reference. Raises FollowError if there is no approach."""
        own, t = settings.controller, self.tick * settings.loop.period
        limits = Limits(
            own.max_reference_rate, np.radians(own.max_reference_tilt_deg), rolls=settings.wire.actuators > 2
        )
        return shortest(Trajectory.of(settings.reference), self.controller.motion.here(t), limits)

    def before(self, k: int) -> None:
        """Apply what was changed up to tick k."""
        while self._later and self._later[0].tick <= k:
            self.applied.append(self._later.popleft())
            self.controller.apply(self.applied[-1])


# ── the rest of the run ──


class _ForkLog:
    """The fork's log: rows of both ends, events, true states; on the recorded plant's wall clock."""

    def __init__(self, path: Path, recording: Recording, recorded: Session, its: _Changes) -> None:
        vehicle, session = recorded.which
        self._settings, self._tick, self._vehicle, self._name = its.settings, its.tick, vehicle, session
        place = int(np.searchsorted(recorded.plant["session_tick"], its.tick))
        row = recorded.plant[min(place, len(recorded.plant) - 1)]
        self._begin_ns = max(int(row["sent"] + row["wall"]), 1)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = LogFile(path)
        except FileExistsError:
            raise OutputError(f"{path} exists already, and logs are never overwritten; name another file") from None
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from None
        described = recording.described(recorded.which)
        loop = its.settings.loop.model_copy(update={"lockstep": True})
        config = its.settings.model_copy(update={"loop": loop}).description()
        same = config == recorded.settings.description()
        for end in ENDS:
            if (one := described.get(end) or next(iter(described.values()), None)) is not None:
                kept = {"config": config, "role": end} | ({} if same else {"certificate": None})
                text = one.model_copy(update=kept).encode()
                self._file.add_description(topics.key("description", vehicle, role=end), text)
        self._writers = {end: TraceWriter(end, its.settings.wire, secrets.randbits(64)) for end in ENDS}
        for writer in self._writers.values():
            writer.session, writer.record = session, record_json(its.in_force)
        self._writers["controller"].state = its.controller.state.model_dump(mode="json")
        rate_hz = its.settings.plant.truth_rate_hz
        self._truth_every = round(its.settings.loop.rate_hz / rate_hz) or 1 if rate_hz else 0

    def _at_ns(self, k: int) -> int:
        return self._begin_ns + (k - self._tick) * self._settings.loop.period_ns

    def controller(
        self, k: int, received_as: Received, measurement: bytes, command: bytes | None, its: _Changes
    ) -> None:
        """Add a tick of the controller."""
        self._writers["controller"].changes += its.applied
        its.applied.clear()
        sent_as = Sent.NONE if command is None else Sent.FRAME if command else Sent.SILENT
        at_ns = self._at_ns(k)
        self._row("controller", k, ControllerRow(k, received_as, sent_as, at_ns, at_ns, measurement, command or b""))

    def plant(self, row: PlantRow, endpoint: Endpoint) -> None:
        """Add a tick of the plant, its events and its true state."""
        at_ns = self._at_ns(row.session_tick)
        if endpoint.session is not None:
            self._row("plant", row.session_tick, row._replace(sent_ns=at_ns, received_ns=at_ns))
        for notice in endpoint.notices:
            self.event("plant", notice.kind, notice.text, row.session_tick)
        endpoint.notices.clear()
        endpoint.changes.clear()
        if self._truth_every and row.session_tick % self._truth_every == 0 and (truth := endpoint.truth()) is not None:
            self._add(topics.key("truth", self._vehicle), truth.encode(), at_ns)

    def event(self, role: str, kind: Any, text: str, k: int) -> None:
        """Add an event of a role at tick k."""
        event = Event(role=role, kind=kind, text=text, session=self._name, tick=k)
        self._add(topics.key("event", self._vehicle, role=role), event.encode(), self._at_ns(k))

    def _row(self, end: End, k: int, row: ControllerRow | PlantRow) -> None:
        self._writers[end].row(row)
        if self._writers[end].due(self._at_ns(k)):
            self._publish(end, k)

    def _publish(self, end: End, k: int, *, final: bool = False) -> None:
        at_ns = self._at_ns(k)
        self._add(
            topics.key("trace", self._vehicle, role=end), self._writers[end].take(at_ns, at_ns, final=final), at_ns
        )

    def _add(self, key: str, payload: bytes, at_ns: int) -> None:
        self._file.add(Delivery(key, payload, 0, at_ns, None), at_ns)

    def close(self, k: int) -> None:
        """Write what is left, and the index."""
        for end in ENDS:
            self._publish(end, k, final=True)
        self._file.commit()
        self._file.end()


def _run(
    out: Path, recording: Recording, recorded: Session, its: _Changes, plant: PlantReplay, later: deque[PlantChange],
    until: int, report: Progress,
) -> str | None:  # fmt: skip
    """Run both ends from the instant up to a tick, and write their log. Returns why it ended before."""
    endpoint, controller, tick = plant.endpoint, its.controller, its.tick
    assert plant.last is not None
    file = _ForkLog(out, recording, recorded, its)
    file.plant(plant.last, endpoint)
    loop, ended = LockstepLoop(endpoint, controller, plant.last.measurement, tick - 1, its.before), None
    for k in range(tick, until + 1):
        command: bytes | None = None
        for one in loop.answer():
            command = one.command
            file.controller(one.k, one.received_as, one.measurement, command, its)
        if controller.fault is not None:
            ended = controller.fault
            file.event("controller", "fault", ended, k)
        elif endpoint.session is None:
            ended = endpoint.cause or "the session ended"
        if ended is not None or k == until:
            break
        while later and later[0].tick <= endpoint.ticked:
            plant.apply(later.popleft())
        loop.advance(command)
        arrival = None if command is None or (not command and not endpoint.lockstep) else Arrival(command, 0)
        file.plant(plant_row(endpoint, loop.measurement, arrival, 0), endpoint)
        if k % 256 == 0:
            report((k - tick) / (until + 1 - tick))
    file.close(until)
    return ended


def _parting(recorded: Session, forked: Session, first: int) -> tuple[Parting | None, int]:
    """The first tick from `first` on at which what an end sent differs, and how many ticks both have."""
    last = min(max(one.extent.last.values()) for one in (recorded, forked))
    found = list[Parting]()
    ends: tuple[tuple[End, Direction], ...] = ("plant", "measurement"), ("controller", "command")
    for end, direction in ends:
        (kind, frames), (other_kind, other_frames) = (
            _sent(one, end, direction, first, last) for one in (recorded, forked)
        )
        differ = (kind != other_kind) | ((kind == Sent.FRAME) & (frames != other_frames))
        if differ.any():
            i = int(np.argmax(differ))
            sent, other = (int(kind[i]), frames[i]), (int(other_kind[i]), other_frames[i])
            found.append(
                Parting(end=end, **dict(tick_difference(recorded.settings, direction, first + i, sent, other)))
            )
    return min(found, key=lambda one: one.tick, default=None), last + 1 - first


def _sent(session: Session, end: End, direction: Direction, first: int, last: int) -> tuple[Integers, Any]:
    """How and what an end sent at each tick; −1 where its row is missing. Shapes (n,)."""
    rows, name = (session.plant, "session_tick") if end == "plant" else (session.controller, "tick")
    if end == "controller":
        rows = rows[np.isin(rows["received_as"], (Received.FRAME, Received.SILENT))]
    rows = rows[(rows[name] >= first) & (rows[name] <= last)]
    kind, frames = np.full(last + 1 - first, -1), np.zeros(last + 1 - first, rows.dtype[direction])
    kind[rows[name] - first], frames[rows[name] - first] = rows["sent_as"], rows[direction]
    return kind, frames
