"""The review: every figure, from a log alone.

The log holds the configuration (in the roles' contracts) and the frames, so the review computes from each measurement
what the controller did, to the last bit (batch.py). A measurement counts once a command has answered it or a later
one: what the controller never used, it does not answer for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from protocol.messages import Event, Lapse, Loss, Status, Telemetry, Truth
from protocol.topics import Address
from protocol.verbs import Change
from service.config import ConfigError, Settings
from service.figures import Figures, Score
from service.logs.batch import BatchController
from service.logs.codes import codes_in, levels
from service.logs.files import LogFiles, ReviewError, Which
from service.logs.filling import Read
from service.logs.findings import facts_of, findings_of, name_of
from service.logs.grounds import Library, damping_of
from service.logs.limits import Limit
from service.logs.observe import Observer
from service.logs.pairing import Pairing, Sessions, Taker, without_collections
from service.logs.report import Findings, Report
from service.logs.story import Story
from service.logs.tallies import BLOCK
from service.logs.theorem import Trial
from service.logs.ticks import Tick, Ticks


class Session(Pairing):
    """One session's frames: read one by one, computed and judged by the block.

    Args:
        settings: The configuration of its controller.
        changes: What its controller followed from which tick on, in order.
        lapses: Where it did not compute with the plant's levels.
        watch: Called with every tick, in order.
        trial: Holds it against the theorem; one of the configuration alone if None.

    Attributes:
        score: Its figures of merit; complete after `finish`, as is what the observer has found.
        observer: Is told every frame and every tick.
    """

    def __init__(
        self,
        settings: Settings,
        changes: Sequence[Change] = (),
        lapses: Sequence[Lapse] = (),
        watch: Callable[[Tick], None] | None = None,
        trial: Trial | None = None,
    ) -> None:
        super().__init__(settings.wire, settings.loop, lapses)
        self.settings = settings
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)
        self.observer = Observer(settings, trial)
        self._controller = BatchController(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._changes = deque(changes)
        self._watch = watch
        self._passed_over: list[tuple[int, Read]] = []
        self._waiting: list[tuple[int, Read, Read, bool]] = []  # tick, measurement, command, whether it answers it

    @property
    def wants_telemetry(self) -> bool:
        """All of it: it is drawn."""
        return True

    def measured(self, frame: bytes, published_ns: int) -> None:
        """See `Pairing.measured`."""
        self.observer.measurement(frame, published_ns)

    def commanded(self, frame: bytes) -> None:
        """See `Pairing.commanded`."""
        self.observer.command(frame)

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """See `Pairing.telemetry`."""
        self.observer.telemetry(telemetry)
        super().telemetry(telemetry, published_ns)

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """The error at tick k counts, and the command."""
        if self._passed_over:
            self._waiting += [(tick, read, command, False) for tick, read in self._passed_over]
            self._passed_over.clear()
        self._waiting.append((k, measurement, command, True))
        if len(self._waiting) >= BLOCK:
            self._judge()

    def passed_over(self, k: int, measurement: Read) -> None:
        """It was not answered, but its error counts."""
        self._passed_over.append((k, measurement))

    def finish(self) -> None:
        """See `Pairing.finish`."""
        super().finish()
        self._judge()
        self.observer.finish()

    def _judge(self) -> None:
        """Compute what waits as the controller did, and score it."""
        if not self._waiting:
            return
        ticks, measurements, commands, answers = zip(*self._waiting, strict=True)
        self._waiting.clear()
        wire = self._wire
        k, answered = np.array(ticks), np.array(answers)
        measured = codes_in(wire.measurement, [read.frame for read in measurements])
        computed = self._controller.compute_all(k, measured, self._changes)
        voltages = levels(wire.voltage, codes_in(wire.command, [read.frame for read in commands]))
        published = np.array([read.published_ns for read in measurements])
        measured_now = np.array([read.sent for read in measurements])
        commanded_now = np.array([read.sent for read in commands])
        timed = answered & measured_now & commanded_now
        latency = np.where(timed, np.array([read.published_ns for read in commands]) - published, nan)
        seen = Ticks(
            k,
            published,
            latency,
            computed.attitude,
            computed.desired,
            computed.rate,
            computed.rate - computed.rate_error,
            computed.attitude_error,
            computed.rate_error,
            voltages,
            computed.sign[:, 0],
            computed.gain,
            computed.damping_estimate,
        )
        valid = ~np.isnan(computed.attitude[:, 0])  # of a measurement without a valid value there is none
        judged = seen.where(valid)
        self.score.errors(judged.k, judged.attitude_error)
        self.score.commands(k[answered], voltages[answered])
        self.score.unsent(int((valid & ~measured_now).sum()), int((answered & ~commanded_now).sum()))
        self.observer.answered(k[answered])
        self.observer.ticks(judged)
        if self._watch is not None:
            for tick in judged.each():
                self._watch(tick)


class Kept(dict[Which, list[Tick]]):
    """Every tick of every session, for those who have the memory: its `watch` is what `read` takes as `watch`."""

    def watch(self, which: Which, settings: Settings) -> Callable[[Tick], None]:
        """Who keeps the ticks of a session."""
        del settings
        return self.setdefault(which, []).append


class Run(Sessions[Session]):
    """The sessions of a run, and what happened beside them.

    Args:
        make: Makes a session.

    Attributes:
        story: What roles told.
    """

    def __init__(self, make: Callable[[Which], Session]) -> None:
        super().__init__(make)
        self.story = Story()
        self._running: dict[str, Session] = {}

    def __missing__(self, which: Which) -> Session:
        self._running[which[0]] = session = super().__missing__(which)
        return session

    def route(self, address: Address) -> Taker | None:
        """Who takes the messages of a key; see `Sessions.route`."""
        story, vehicle, role = self.story, address.vehicle, address.role
        match address.topic.name:
            case "truth":
                return partial(self._truth, vehicle)
            case "event":
                return lambda payload, at_ns: story.event(vehicle, Event.model_validate_json(payload), at_ns)
            case "loss":
                return lambda payload, _: story.loss(vehicle, Loss.model_validate_json(payload))
            case "status" if role is not None:
                return lambda payload, _: story.status(vehicle, role, Status.model_validate_json(payload))
        return super().route(address)

    def _truth(self, vehicle: str, payload: bytes, published_ns: int) -> None:
        if session := self._running.get(vehicle):
            truth = Truth.model_validate_json(payload)
            session.observer.truth(truth.attitude, published_ns)
            if truth.session is None or self.get((vehicle, truth.session)) is session:
                session.observer.trial.truth(truth.session_tick, truth.attitude, truth.rate)


class Review(NamedTuple):
    """What a log says of its longest session.

    Attributes:
        figures: The figures of merit alone.
        findings: The same figures and everything else.
        session: The session.
        which: Its vehicle and name.
        name: What to call the run.
        facts: About software and host, by role.
    """

    figures: Figures
    findings: Findings
    session: Session
    which: Which
    name: str
    facts: dict[str, dict[str, Any]]

    def report(self, limits: Sequence[Limit] = ()) -> Report:
        """All of it as data, held to limits."""
        observer = self.session.observer
        time, panels = observer.lines()
        return Report(
            name=self.name,
            findings=self.findings.model_copy(update={"checks": [limit.check(self.findings) for limit in limits]}),
            time=time,
            panels=panels,
            thinned=observer.thinned,
            settings=self.session.settings.contract(),
            facts=self.facts,
        )


def review(*paths: Path) -> Figures:
    """Judge a run: the figures of its longest session. Raises as `read` does."""
    return read(*paths).figures


def report(
    paths: Sequence[Path], limits: Sequence[Limit] = (), progress: Callable[[float], None] | None = None
) -> Report:
    """Everything that a log says of its longest session, as data. Raises as `read` does.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        limits: What its figures are held to.
        progress: Called now and then with the share that is done, 0…1.
    """
    return read(*paths, progress=progress).report(limits)


@without_collections()
def read(
    *paths: Path,
    watch: Callable[[Which, Settings], Callable[[Tick], None]] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Review:
    """Read a run and judge its longest session. What cannot be read of a broken file is named in the figures.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        watch: Asked for every session, given its vehicle, name and configuration, who is to be told each of its ticks.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        ReviewError: Not a log, or one without a session.
    """
    try:
        files = LogFiles(paths)
        settings = files.settings

        library, damping = Library(settings, files.promised), damping_of(files.plant)

        def session(which: Which) -> Session:
            changes, watched = files.changes.get(which, ()), watch(which, settings) if watch else None
            trial = Trial(library.of(changes), changes, settings.loop.period, damping)
            return Session(settings, changes, files.lapses.get(which, ()), watched, trial)

        run = Run(session)
        for take, payload, published_ns in files.routed(run.route, progress):
            take(payload, published_ns)
    except (ValidationError, ConfigError) as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    if not run:
        raise ReviewError(f"{files.name} holds no session: no measurement or command frame was recorded")
    for one in run.values():
        one.finish()
    longest, story = max(run, key=lambda which: run[which].score.ticks), run.story
    figures = _figures(run[longest], story.statuses.get((longest[0], "plant")), files, story.trips)
    told, observer = (files.changes.get(longest, ()), files.lapses.get(longest, ())), run[longest].observer
    findings = findings_of(figures, longest, settings, observer, story, *told, len(run))
    facts = facts_of(files, story, longest[0])
    return Review(figures, findings, run[longest], longest, name_of(paths), facts)


def _figures(session: Session, plant: Status | None, files: LogFiles, trips: list[str]) -> Figures:
    reasons: dict[str, str] = {}
    latency = plant.latency_us if plant else None
    if latency is None:
        reasons["latency_us"] = "the log has no status of the plant with a latency"
    damages = [f"{path}: {damage.what}" for path, found in files.damages.items() for damage in found]
    return session.score.figures(latency=latency, log=files.name, trips=trips, reasons=reasons, damages=damages)
