"""The review: every figure, from a log alone.

The log holds the configuration (in the roles' contracts) and the frames, so the review decodes each measurement as the
controller did, with the controller's own code, and asks it for the error. A measurement counts once a command has
answered it or a later one: what the controller never used, it does not answer for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from pydantic import ValidationError

from protocol.attitude import Quaternion, Vector
from protocol.messages import Event, Loss, Status, Telemetry, Truth
from protocol.verbs import Change
from service.config import ConfigError, Settings
from service.controller import Controller
from service.figures import Figures, Score
from service.log.files import LogFiles, ReviewError, Which
from service.log.findings import facts_of, findings_of, name_of
from service.log.limits import Limit
from service.log.observe import Observer
from service.log.pairing import Pairing, Read, Seen, without_collections
from service.log.report import Findings, Report
from service.log.story import Story

TOPICS_READ: Final = frozenset({"measurement", "command", "telemetry", "truth", "event", "status", "loss"})


class Tick(NamedTuple):
    """One tick of a session as the controller saw it.

    Attributes:
        k: Tick of the law; its time is k·period.
        published_ns: When its measurement was published, on the plant's wall clock [ns].
        latency_ns: From then until the command that answered it was published [ns]; None if none did.
        attitude: q as measured. The other quantities of the law likewise, in its units.
        voltages: What was commanded, or, of a measurement that was passed over, what the next command said [V]; NaN
            where a command had no valid value.
    """

    k: int
    published_ns: int
    latency_ns: int | None
    attitude: Quaternion
    desired: Quaternion
    rate: Vector
    desired_rate: Vector
    attitude_error: Vector
    rate_error: Vector
    voltages: tuple[float, ...]


class Session(Pairing):
    """One session's frames, scored as they are read.

    Args:
        settings: The configuration of its controller.
        changes: What its controller followed from which tick on, in order.
        watch: Called with every tick, in order.
    """

    def __init__(
        self, settings: Settings, changes: Sequence[Change] = (), watch: Callable[[Tick], None] | None = None
    ) -> None:
        self.settings = settings
        self._changes = deque(changes)
        super().__init__(settings.wire, settings.loop)
        self._controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._level = settings.wire.voltage.quantizer().level
        self._passed_over: list[tuple[int, Read]] = []
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)
        self._watch = watch

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """Score the error at tick k, and the command."""
        level = self._level
        voltages = tuple([level(code) for code in command.codes])
        if self._passed_over:
            for tick, read in self._passed_over:
                self._score(tick, read, None, voltages)
            self._passed_over.clear()
        self._score(k, measurement, command.published_ns - measurement.published_ns, voltages)
        self.score.command(k, voltages)

    def passed_over(self, k: int, measurement: Read) -> None:
        """It was not answered, but its error counts."""
        self._passed_over.append((k, measurement))

    def _score(self, k: int, read: Read, latency_ns: int | None, voltages: tuple[float, ...]) -> None:
        controller = self._controller
        while self._changes and self._changes[0].tick <= k:
            controller.apply(self._changes.popleft())
        controller.compute(read.counter, read.codes, k)
        if controller.tick_index != k:
            return  # a measurement without a valid value
        attitude_error = controller.attitude_error
        self.score.error(k, attitude_error)
        if self._watch is not None:
            rate, rate_error = controller.rate, controller.rate_error
            desired_rate = rate[0] - rate_error[0], rate[1] - rate_error[1], rate[2] - rate_error[2]
            self._watch(
                Tick(
                    k,
                    read.published_ns,
                    latency_ns,
                    controller.attitude,
                    controller.desired,
                    rate,
                    desired_rate,
                    attitude_error,
                    rate_error,
                    voltages,
                )
            )


class Kept(dict[Which, list[Tick]]):
    """Every tick of every session, for those who have the memory: its `watch` is what `read` takes as `watch`."""

    def watch(self, which: Which, settings: Settings) -> Callable[[Tick], None]:
        """Who keeps the ticks of a session."""
        del settings
        return self.setdefault(which, []).append


class ObservedSession(Session):
    """A session whose observer is told of every frame and every tick."""

    def __init__(
        self, settings: Settings, changes: Sequence[Change] = (), watch: Callable[[Tick], None] | None = None
    ) -> None:
        self.observer = Observer(settings)
        super().__init__(settings, changes, self.observer.tick if watch is None else self._both(watch))

    def measured(self, measurement: Read) -> None:
        """See `Pairing.measured`."""
        self.observer.measurement(measurement.codes, measurement.published_ns)
        super().measured(measurement)

    def commanded(self, command: Read) -> None:
        """See `Pairing.commanded`."""
        self.observer.command(command.codes)
        super().commanded(command)

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """See `Pairing.telemetry`."""
        self.observer.telemetry(telemetry)
        super().telemetry(telemetry, published_ns)

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """See `Pairing.answered`."""
        self.observer.answered(k)
        super().answered(k, measurement, command)

    def finish(self) -> None:
        """See `Pairing.finish`."""
        super().finish()
        self.observer.finish()

    def _both(self, watch: Callable[[Tick], None]) -> Callable[[Tick], None]:
        observe = self.observer.tick

        def told(tick: Tick) -> None:
            observe(tick)
            watch(tick)

        return told


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
    session: ObservedSession
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
    sessions: dict[Which, ObservedSession] = {}
    running: dict[str, ObservedSession] = {}
    story = Story()
    try:
        files = LogFiles(paths)
        settings = files.settings
        for address, payload, published_ns in files.messages(TOPICS_READ, progress):
            vehicle, name = address.vehicle, address.topic.name
            if address.session is not None:
                which = vehicle, address.session
                if which not in sessions:
                    told = watch(which, settings) if watch else None
                    sessions[which] = ObservedSession(settings, files.changes.get(which, ()), told)
                    running[vehicle] = sessions[which]
                seen = Seen(payload, published_ns)
                if name == "measurement":
                    sessions[which].measurement(seen)
                else:
                    sessions[which].command(seen)
            elif name == "telemetry":
                telemetry = Telemetry.model_validate_json(payload)
                if session := sessions.get((vehicle, telemetry.session)):
                    session.telemetry(telemetry, published_ns)
            elif name == "truth":
                if vehicle in running:
                    running[vehicle].observer.truth(Truth.model_validate_json(payload).attitude, published_ns)
            elif name == "event":
                story.event(vehicle, Event.model_validate_json(payload), published_ns)
            elif name == "loss":
                story.loss(vehicle, Loss.model_validate_json(payload))
            elif address.role is not None:
                story.status(vehicle, address.role, Status.model_validate_json(payload))
    except (ValidationError, ConfigError) as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    if not sessions:
        raise ReviewError(f"{files.name} holds no session: no measurement or command frame was recorded")
    for session in sessions.values():
        session.finish()
    longest = max(sessions, key=lambda which: sessions[which].score.ticks)
    figures = _judge(sessions[longest], story.statuses.get((longest[0], "plant")), files, story.trips)
    changes, observer = files.changes.get(longest, ()), sessions[longest].observer
    findings = findings_of(figures, longest, settings, observer, story, changes, len(sessions))
    facts = facts_of(files, story, longest[0])
    return Review(figures, findings, sessions[longest], longest, name_of(paths), facts)


def _judge(session: Session, plant: Status | None, files: LogFiles, trips: list[str]) -> Figures:
    reasons: dict[str, str] = {}
    latency = plant.latency_us if plant else None
    if latency is None:
        reasons["latency_us"] = "the log has no status of the plant with a latency"
    damages = [f"{path}: {damage.what}" for path, found in files.damages.items() for damage in found]
    return session.score.figures(latency=latency, log=files.name, trips=trips, reasons=reasons, damages=damages)
