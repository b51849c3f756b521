"""Fork: a recorded run, continued in lockstep from one of its instants with something changed.

Both ends are computed again up to the plant's measurement of that tick, from what they received; from there on the loop
closes in this process. What came from outside, such as an operator's later gains, references, faults and stop, acts as
recorded unless the fork replaces it; releases and lost sessions do not. Frames that an injected fault holds back are
in flight at that instant, too: the controller goes on with the measurement that reaches it next. So a fork with no
change repeats a lockstep log, and a real-time one up to the first tick at which the network lost or delayed a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.trace import PlantReplay, cut, plant_row
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Change, Gains, in_force
from aeroloop.protocol.messages.trace import (
    ENDS,
    Batch,
    End,
    PlantChange,
    Received,
    Sent,
)
from aeroloop.protocol.wire.frames import TickCounter
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings, from_description, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.registry import gains_of, law_class, with_gains
from aeroloop.service.control.motion import Approach, shortest
from aeroloop.service.control.reference import Limits, Trajectory
from aeroloop.service.figures import Figures
from aeroloop.service.lab.lockstep import LockstepLog, LockstepLoop, tick_of
from aeroloop.service.logs.frames import Direction
from aeroloop.service.logs.mcap_file import FORK_METADATA
from aeroloop.service.logs.outputs import check_output, writing_into
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.replay import TickDifference, tick_difference
from aeroloop.service.logs.session import Integers, Session
from aeroloop.service.logs.ticks import LoggedController, Ticks, without
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
    """A fork, judged as any log is, beside the same span of the recorded run."""

    tick: int
    at_s: float
    changed: list[str]  # what is different from the recorded run, a line each
    parts: Parting | None  # None: it repeats the recorded run
    compared: int  # ticks from `tick` on that both have
    network: int | None  # the first tick at which a command was late or lost that is not in the fork, or the reverse
    ended: str | None  # why it ended before its time
    differed: str | None  # where the plant, computed again, already differed before the fork
    log: Path | None
    forked: Review
    recorded: Review

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
            reference and, of an emulated body, its mechanics, wind and sensors. Gains and reference hold whatever was
            recorded later.
        faults: Faults to inject after that tick's measurement, as `op inject` would.
        duration_s: Length of the fork [s]; to the end of the recorded session if None.
        log: New file for the fork's ticks; None for none.
        progress: Called with the share done.

    Raises:
        ForkError: It cannot be forked so.
        AeroloopError: The log cannot be read, the new one cannot be written, or an override or a fault is wrong.
    """
    check_output(log, paths)
    report = progress or (lambda _: None)
    recording = Recording(paths, lambda share: report(share / 2))
    which = recording.choose(session, vehicle)
    recorded = recording.session(which)
    period = recorded.settings.loop.period
    tick = at if isinstance(at, int) else round(at / period)
    last = recorded.extent.last["controller"]
    if not 0 <= tick <= last:
        raise ForkError(f"the session has ticks 0 to {last}, up to {last * period:g} s, and none {tick}")
    _check_known(recorded, tick)
    settings = load_over(recorded.settings, overrides) if overrides else recorded.settings
    until = last if duration_s is None else tick + max(1, round(duration_s / settings.loop.period)) - 1
    instant = _plant_at(recording, recorded, settings, tick, report)
    its = _Changes(recorded, settings, instant.next_tick, overrides)
    if faults:
        instant.plant.endpoint.inject([Fault.parse(text) for text in faults])
    differed, where = instant.plant.result().first_difference, None
    if differed is not None:
        where = f"the plant, computed again, differs from the log from tick {differed.session_tick} on"
    with ExitStack() as stack:
        if log is None:
            out = Path(stack.enter_context(TemporaryDirectory())) / "fork.mcap"
        else:
            out = stack.enter_context(writing_into(log.parent, paths)) / log.name
        begun = stack.enter_context(closing(_begin_log(out, recording, recorded, its, instant, tick)))
        ended = _run(begun, its, instant, tick, until, lambda share: report(REPLAYED + 0.3 * share))
        begin_s = tick * period
        in_flight = instant.next_tick < tick  # measurements of before the instant are answered after it
        forked = _of(read(out, since_s=begin_s) if in_flight else read(out), log)
        found = Recording([out]).session(which)
        # The fork may have ended before the recorded run, or have no valid value: both are judged up to the same tick.
        last_judged = int(forked.ticks.k[-1]) if len(forked.ticks.k) else tick
        end_s = (last_judged + 0.5) * settings.loop.period
        known = read(*paths, session="/".join(which), since_s=begin_s, until_s=end_s)
    same_wire = (recorded.settings.loop, recorded.settings.wire) == (settings.loop, settings.wire)
    first: dict[End, int] = {"plant": tick, "controller": instant.next_tick}
    parts, compared, network = _parting(recorded, found, first) if same_wire else (None, 0, None)
    report(1.0)
    return Fork(tick, tick * period, [*overrides, *faults], parts, compared, network, ended, where, log, forked, known)


def _of(forked: Review, log: Path | None) -> Review:
    """The review of a fork whose log was written elsewhere than where it stays, if it stays."""
    name, why = str(log) if log else None, {} if log else {"log": "no new log was named"}
    return replace(
        forked,
        figures=forked.figures.model_copy(update={"log": name, "reasons": forked.figures.reasons | why}),
        findings=forked.findings.model_copy(update={"log": name, "reasons": forked.findings.reasons | why}),
    )


# ── both ends at the instant ──


def _check_known(recorded: Session, tick: int) -> None:
    """Raise ForkError unless the log holds what was in force at a tick, and the law's state."""
    for unknown in recorded.unknown:
        if unknown.first_tick <= tick <= unknown.last_tick:
            raise ForkError(f"tick {tick} cannot be forked: {unknown}")
    for gap in recorded.missing:
        last_tick = tick if gap.last_tick is None else gap.last_tick
        if gap.end == "controller" and gap.rows and gap.first_tick < tick <= last_tick:
            raise ForkError(f"tick {tick} cannot be forked: the log lacks {gap}")


class _InFlight:
    """Ticks of the measurements that have left a plant, as its controller counts them, while it is computed again.

    `reached` is the tick of the last one that had left before the plant's present tick, −1 for none; `next_tick` is
    that of the first one that leaves then, or is due next.
    """

    def __init__(self, wire: WireSpec, loop: LoopSettings) -> None:
        self._layout, self._lockstep = wire.measurement, loop.lockstep
        self._ticks = TickCounter(loop.period_ns, self._layout.counters, lockstep=True)
        self.reached = -1
        self.next_tick = 0

    def follow(self, endpoint: Endpoint) -> None:
        """The plant has ticked."""
        if endpoint.session_tick == 0:
            self._ticks.tick = -1  # another session
        self.reached = self._ticks.tick
        left = list[int]()
        for frame in endpoint.outgoing:
            if frame == UNCHANGED and not self._lockstep:  # no frame: the controller takes the tick that is over
                self._ticks.tick = max(self._ticks.tick, endpoint.session_tick)
                left.append(self._ticks.tick)
                continue
            tick = tick_of(self._ticks, self._layout, frame)
            if tick is not None:
                left.append(tick)
        self.next_tick = left[0] if left else self.reached + 1


class _Instant(NamedTuple):
    """The plant end after its measurement of a tick, and what comes after it."""

    plant: PlantReplay
    later: deque[PlantChange]  # that came from outside
    reached: int  # tick of the last measurement that the controller has received by then, −1 for none
    next_tick: int  # tick of the measurement that it receives next
    at_ns: int  # when that tick was measured, on the plant's wall clock [ns since 1970]


def _plant_at(recording: Recording, recorded: Session, settings: Settings, tick: int, report: Progress) -> _Instant:
    """The instant at which the plant end has measured a tick."""
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
            return _plant_anew(batches, session, settings)
        if wrong := [name for name in another if name != "plant"]:
            raise ForkError(f"{wrong[0]}.* holds from the session's start: fork it --at 0")
        in_flight = _InFlight(was.wire, was.loop)
        plant = PlantReplay(was.loop, was.wire, was.plant, in_flight.follow)
    except ValueError as error:
        raise ForkError(str(error)) from None
    left, later = sum(batch.header.rows for batch in batches), deque[PlantChange]()
    rows, found, at_ns = max(1, left), False, 0
    for batch in batches:
        ticks = batch.columns["session_tick"]
        wanted = int(np.searchsorted(ticks, tick, "right")) if batch.header.session == session else len(ticks)
        if not found:
            found = batch.header.session == session and wanted > 0 and int(ticks[wanted - 1]) == tick
            plant.feed(cut(batch, wanted) if found else batch)
            if found:
                at_ns = _measured_ns(batch, wanted - 1)
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
    after = deque(change for change in later if change.tick >= ticked)
    return _Instant(plant, after, in_flight.reached, in_flight.next_tick, at_ns)


def _measured_ns(batch: Batch, row: int) -> int:
    """When a row of a plant's batch was measured, on its wall clock [ns since 1970]."""
    if not 0 <= row < batch.header.rows:
        return batch.header.wall_ns
    sent_ns = int(batch.times_ns("sent")[row])
    return batch.header.wall_ns + max(0, sent_ns - batch.header.monotonic_ns)


def _plant_anew(batches: Sequence[Batch], session: str, settings: Settings) -> _Instant:
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
                return _Instant(plant, deque(), -1, 0, _measured_ns(batch, 0))
        if batch.header.rows:
            raise ForkError(
                "another plant, wire or loop holds from the plant's start, and the session is not its first"
            )
    raise ForkError("the log lacks the session's claim")


class _Changes:
    """The controller at an instant, and the changes of gains and reference that it follows from there on."""

    def __init__(self, recorded: Session, settings: Settings, tick: int, overrides: Sequence[str]) -> None:
        self.settings, self.tick, self.name = settings, tick, recorded.which[1]
        law, before = law_class(settings.law), recorded.settings
        keys = [override.partition("=")[0].strip() for override in overrides]
        given = {name: getattr(settings.law, name) for name in law.gains if f"law.{name}" in keys}
        if given:
            with_gains(settings.law, Gains.model_validate(given))  # raises LawError
        follows = any(key.startswith("reference") for key in keys)
        past = [change for change in recorded.changes if change.tick <= tick]
        replaced = [key for key in keys if key != "law.kind"]
        future = [without(change, replaced) for change in recorded.changes if change.tick > tick]
        if another := settings.law.kind != before.law.kind:
            given = gains_of(settings.law).named | given
            past, future = ([each.model_copy(update={"gains": None}) for each in some] for some in (past, future))

        self.controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        for change in past:
            self.controller.apply(change)
        if tick:
            logged, rows = LoggedController(recorded), recorded.controller
            later = (rows["tick"] >= tick) & np.isin(rows["received_as"], (Received.FRAME, Received.SILENT))
            first_later = int(np.argmax(np.append(later, True)))
            for _ in islice(logged.answers(), first_later):
                pass
            logged.resume(first_later)  # where the rows before it are missing
            self.controller.restore(logged.controller.state)
        own = Change(session=self.name, tick=tick, gains=Gains.model_validate(given) if given or another else None)
        if follows:
            approach = self._approach(settings) if tick else Approach()
            own = own.model_copy(update={"reference": settings.reference, **approach._asdict()})
        if given or another or follows:
            self.controller.apply(own)
            past = [*past, own]
        self.in_force, self._later = in_force(past), deque(future)
        self.applied: list[Change] = []  # since they were last recorded

    def _approach(self, settings: Settings) -> Approach:
        """As `op track` approaches a reference. Raises FollowError if there is no approach."""
        here = self.controller.motion.here(self.tick * settings.loop.period)
        limits = Limits.of(settings.controller, settings.wire.actuators)
        return shortest(Trajectory.of(settings.reference), here, limits)

    def before(self, k: int) -> None:
        """Apply what was changed up to tick k."""
        while self._later and self._later[0].tick <= k:
            self.applied.append(self._later.popleft())
            self.controller.apply(self.applied[-1])


# ── the rest of the run ──


def _begin_log(
    path: Path, recording: Recording, recorded: Session, its: _Changes, instant: _Instant, tick: int
) -> LockstepLog:
    """The fork's log, which begins at the wall time of its tick on the recorded plant's clock."""
    described = recording.described(recorded.which)
    log = LockstepLog(path, its.settings, recorded.which, tick, instant.at_ns)
    log.add_metadata(FORK_METADATA, tick=tick, session="/".join(recorded.which), logs=[*map(str, recording.paths)])
    changed = {} if its.settings == recorded.settings else {"certificate": None}
    for end in ENDS:
        log.describe((described.get(end) or described["plant"]).model_copy(update={"role": end, **changed}))
    log.begin(its.controller, its.in_force)
    return log


def _run(log: LockstepLog, its: _Changes, instant: _Instant, tick: int, until: int, report: Progress) -> str | None:
    """Run both ends from the instant up to a tick. Returns why it ended before."""
    plant, later, controller = instant.plant, instant.later, its.controller
    endpoint = plant.endpoint
    assert plant.last is not None
    log.plant(plant.last, endpoint)
    loop, ended = LockstepLoop(endpoint, controller, plant.last.measurement, instant.reached, its.before), None
    for k in range(tick, until + 1):
        command: bytes | None = None
        for one in loop.answer():
            command = one.command
            log.controller(one, its.applied)
            its.applied = []
        if controller.fault is not None:
            ended = controller.fault
            log.event("controller", "fault", ended, k)
        elif endpoint.session is None:
            ended = endpoint.cause or "the session ended"
        if ended is not None or k == until:
            break
        while later and later[0].tick <= endpoint.ticked:
            plant.apply(later.popleft())
        arrival = loop.advance(command)
        log.plant(plant_row(endpoint, loop.measurement, arrival, 0), endpoint)
        if k % 256 == 0:
            report((k - tick) / (until + 1 - tick))
    log.finish(until)
    return ended


def _parting(recorded: Session, forked: Session, first_ticks: dict[End, int]) -> tuple[Parting | None, int, int | None]:
    """The first tick at which what an end sent differs, of each end from its first on, and how many ticks both have.

    And the first tick at which the plant acted on another measurement's answer, which in the fork the network decides.
    """
    found, compared = list[Parting](), list[int]()
    ends: tuple[tuple[End, Direction], ...] = ("plant", "measurement"), ("controller", "command")
    for end, direction in ends:
        first, last = first_ticks[end], min(session.extent.last[end] for session in (recorded, forked))
        compared.append(max(0, last + 1 - first))
        if not compared[-1]:
            continue
        one, other = (_sent(each, end, direction, first, last) for each in (recorded, forked))
        differ = (one[0] != other[0]) | ((one[0] == Sent.FRAME) & (one[1] != other[1]))
        if differ.any():
            i = int(np.argmax(differ))
            sides = (int(one[0][i]), one[1][i]), (int(other[0][i]), other[1][i])
            found.append(Parting(end=end, **dict(tick_difference(recorded.settings, direction, first + i, *sides))))
    acted = (one.plant[["session_tick", "answered"]] for one in (recorded, forked))
    of_one, of_other = (dict(rows[rows["session_tick"] > first_ticks["plant"]].tolist()) for rows in acted)
    network = next((k for k, answered in of_one.items() if of_other.get(k, answered) != answered), None)
    return min(found, key=lambda each: each.tick, default=None), min(compared), network


def _sent(session: Session, end: End, direction: Direction, first: int, last: int) -> tuple[Integers, Any]:
    """How and what an end sent at each tick; −1 where its row is missing. Shapes (n,)."""
    rows, name = (session.plant, "session_tick") if end == "plant" else (session.controller, "tick")
    if end == "controller":
        rows = rows[np.isin(rows["received_as"], (Received.FRAME, Received.SILENT))]
    rows = rows[(rows[name] >= first) & (rows[name] <= last)]
    kind, frames = np.full(last + 1 - first, -1), np.zeros(last + 1 - first, rows.dtype[direction])
    kind[rows[name] - first], frames[rows[name] - first] = rows["sent_as"], rows[direction]
    return kind, frames
