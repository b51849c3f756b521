"""The review: every figure, from a log alone.

The log holds the configuration (in the roles' contracts) and the frames, so the review decodes each measurement as the
controller did, with the controller's own code, and asks it for the error. A measurement counts once a command has
answered it or a later one: what the controller never used, it does not answer for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from pydantic import ValidationError

from protocol.attitude import Quaternion, Vector
from protocol.messages import Event, Status, Telemetry
from protocol.verbs import Change
from service.config import ConfigError, Settings
from service.controller import Controller
from service.figures import Figures, Score
from service.log.files import LogFiles, ReviewError, Which
from service.log.pairing import Pairing, Seen

TOPICS_READ: Final = frozenset({"measurement", "command", "telemetry", "event", "status"})


class Tick(NamedTuple):
    """One tick of a session as the controller saw it: what the figures of the paper draw."""

    k: int
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
        keep: Whether to keep every tick, for figures.
    """

    def __init__(self, settings: Settings, changes: Sequence[Change] = (), *, keep: bool = False) -> None:
        self.settings = settings
        self._changes = deque(changes)
        super().__init__(settings.wire, settings.loop)
        self._controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._level = settings.wire.voltage.quantizer().level
        self._passed_over: list[tuple[int, Seen]] = []
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)
        self.ticks: list[Tick] | None = [] if keep else None

    def answered(self, k: int, measurement: Seen, command: bytes, codes: tuple[float, ...]) -> None:
        """Score the error at tick k, and the command."""
        del command
        voltages = [self._level(code) for code in codes]
        for tick, seen in (*self._passed_over, (k, measurement)):
            self._score(tick, seen, voltages)
        self._passed_over.clear()
        self.score.command(k, voltages)

    def passed_over(self, k: int, measurement: Seen) -> None:
        """It was not answered, but its error counts."""
        self._passed_over.append((k, measurement))

    def _score(self, k: int, seen: Seen, voltages: list[float]) -> None:
        controller = self._controller
        while self._changes and self._changes[0].tick <= k:
            controller.apply(self._changes.popleft())
        controller.tick(seen.frame, k)
        if controller.tick_index != k:
            return  # a measurement without a valid value
        self.score.error(k, controller.attitude_error)
        if self.ticks is not None:
            rate, rate_error = controller.rate, controller.rate_error
            desired_rate = rate[0] - rate_error[0], rate[1] - rate_error[1], rate[2] - rate_error[2]
            self.ticks.append(
                Tick(
                    k,
                    controller.attitude,
                    controller.desired,
                    rate,
                    desired_rate,
                    controller.attitude_error,
                    rate_error,
                    tuple(voltages),
                )
            )


class Review(NamedTuple):
    """What a log says: figures of its longest session, and that session."""

    figures: Figures
    session: Session


def review(*paths: Path) -> Figures:
    """Judge a run: the figures of its longest session. Raises as `read` does."""
    return read(*paths).figures


def read(*paths: Path, keep: bool = False, progress: Callable[[float], None] | None = None) -> Review:
    """Read a run and judge its longest session. What cannot be read of a broken file is named in the figures.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        keep: Whether to keep every tick of every session, for figures.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        ReviewError: Not a log, or one without a session.
    """
    sessions: dict[Which, Session] = {}
    statuses: dict[tuple[str, str], Status] = {}
    trips: list[str] = []
    try:
        files = LogFiles(paths)
        settings = files.settings
        for address, payload, published_ns in files.messages(TOPICS_READ, progress):
            if address.session is not None:
                which = address.vehicle, address.session
                if which not in sessions:
                    sessions[which] = Session(settings, files.changes.get(which, ()), keep=keep)
                seen = Seen(payload, published_ns)
                if address.topic.name == "measurement":
                    sessions[which].measurement(seen)
                else:
                    sessions[which].command(seen)
            elif address.topic.name == "telemetry":
                telemetry = Telemetry.model_validate_json(payload)
                if session := sessions.get((address.vehicle, telemetry.session)):
                    session.telemetry(telemetry, published_ns)
            elif address.topic.name == "event":
                event = Event.model_validate_json(payload)
                if event.kind == "tripped":
                    trips.append(event.text)
            elif address.role is not None:
                statuses[address.vehicle, address.role] = Status.model_validate_json(payload)
    except (ValidationError, ConfigError) as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    if not sessions:
        raise ReviewError(f"{files.name} holds no session: no measurement or command frame was recorded")
    for session in sessions.values():
        session.finish()
    vehicle, name = max(sessions, key=lambda which: sessions[which].score.ticks)
    longest = sessions[vehicle, name]
    plant = statuses.get((vehicle, "plant"))
    return Review(_judge(longest, plant, files, trips), longest)


def _judge(session: Session, plant: Status | None, files: LogFiles, trips: list[str]) -> Figures:
    reasons: dict[str, str] = {}
    latency = plant.latency_us if plant else None
    if latency is None:
        reasons["latency_us"] = "the log has no status of the plant with a latency"
    damages = [f"{path}: {damage.what}" for path, found in files.damages.items() for damage in found]
    return session.score.figures(latency=latency, log=files.name, trips=trips, reasons=reasons, damages=damages)
