"""Replay: a log's measurements through the controller again, and every command compared with the one that was logged.

The controller is sans-I/O, and what an operator changed is in the log with its tick, so the same frames in must give
the same frames out, byte for byte. With another configuration it says what would have been commanded instead; the plant
of the log does not follow that, so it is no simulation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import sqrt
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from protocol.messages import Telemetry
from protocol.verbs import Change
from service.config import Settings, load_over
from service.controller import Controller
from service.log.files import LogFiles, Which
from service.log.pairing import MAX_WAITING, Pairing, Read, Seen, Sessions


class Difference(BaseModel):
    """The first command that was computed otherwise than it was logged."""

    model_config = ConfigDict(frozen=True)

    tick: int
    time_s: float = Field(description="on the law's clock [s]")
    logged: str = Field(description="the frame, in hexadecimal")
    computed: str


class SessionReplay(BaseModel):
    """What replaying one session has shown."""

    model_config = ConfigDict(frozen=True)

    vehicle: str
    session: str
    first_tick: int | None = Field(description="where the replay could begin; null if nowhere")
    commands: int = Field(description="commands compared")
    differing: int
    first_difference: Difference | None
    rms_v: float | None = Field(description="root mean square of the difference between computed and logged levels [V]")
    max_v: float | None = Field(description="largest difference of a motor [V]")
    u_total_logged: float = Field(description="∫ uᵀu dt of the commands compared [V²·s]")
    u_total_computed: float


class Replayer(Pairing):
    """Replays one session.

    Args:
        settings: The controller's configuration.
        changes: What it followed from which tick on, in order.
    """

    def __init__(self, settings: Settings, changes: Sequence[Change]) -> None:
        super().__init__(settings.wire, settings.loop)
        self._controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._changes = deque(changes)
        self._level = settings.wire.voltage.quantizer().level
        self._period = settings.loop.period
        self._begun = False
        self._unplaced: deque[Telemetry] = deque(maxlen=MAX_WAITING)
        self._held: deque[tuple[int, Read, Read]] = deque(maxlen=MAX_WAITING)  # until it is known where to begin
        self.first_tick: int | None = None
        self.first_difference: Difference | None = None
        self.commands = self.differing = 0
        self._square = self._largest = self._logged = self._computed = 0.0

    @property
    def wants_telemetry(self) -> bool:
        """Until it is known where to begin."""
        return not self._begun

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """Compute the command of tick k again."""
        if self._begun:
            self._compare(k, measurement, command)
        else:
            self._held.append((k, measurement, command))

    def passed_over(self, k: int, measurement: Read) -> None:
        """The controller never saw it."""

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """The first telemetry whose tick is known tells where to begin, and with what if that is not the start."""
        super().telemetry(telemetry, published_ns)
        self._unplaced.append(telemetry)
        while not self._begun and self._unplaced and self._held and self._unplaced[0].tick <= self._held[-1][0]:
            self._begin(self._unplaced.popleft())

    def finish(self) -> None:
        """No more is to come."""
        super().finish()
        while not self._begun and self._unplaced:
            self._begin(self._unplaced.popleft())

    def _begin(self, telemetry: Telemetry) -> None:
        tick = telemetry.tick
        held = next((pair for pair in self._held if pair[0] == tick), None)
        if held is None:
            return
        _, measurement, command = held
        self._follow(tick)
        computed = self._controller.tick(measurement.frame, tick)
        controller = self._controller
        told = telemetry.sign, telemetry.damping_estimate, telemetry.attitude_error
        if held is self._held[0] and told == (controller.sign, controller.damping_estimate, controller.attitude_error):
            self.first_tick = tick  # the session's very first: nothing had been computed before it
            self._count(tick, computed, command)
        else:
            controller.resume(measurement.frame, tick, *told)
            self.first_tick = tick + 1
        self._begun = True
        for k, measurement, command in self._held:
            if k > tick:
                self._compare(k, measurement, command)
        self._held.clear()

    def result(self, vehicle: str, session: str) -> SessionReplay:
        """What has been found."""
        compared = self.commands > 0
        return SessionReplay(
            vehicle=vehicle,
            session=session,
            first_tick=self.first_tick,
            commands=self.commands,
            differing=self.differing,
            first_difference=self.first_difference,
            rms_v=sqrt(self._square / self.commands) if compared else None,
            max_v=self._largest if compared else None,
            u_total_logged=self._logged * self._period,
            u_total_computed=self._computed * self._period,
        )

    def _follow(self, k: int) -> None:
        while self._changes and self._changes[0].tick <= k:
            self._controller.apply(self._changes.popleft())

    def _compare(self, k: int, measurement: Read, logged: Read) -> None:
        if self._changes:
            self._follow(k)
        self._count(k, self._controller.answer(measurement.counter, measurement.codes, k), logged)

    def _count(self, k: int, computed: bytes | None, logged: Read) -> None:
        theirs = self._volts(logged.codes)
        square = sum([u * u for u in theirs])
        self.commands += 1
        self._logged += square
        if computed == logged.frame:
            self._computed += square
            return
        self.differing += 1
        if self.first_difference is None:
            self.first_difference = Difference(
                tick=k,
                time_s=round(k * self._period, 9),
                logged=logged.frame.hex(),
                computed=computed.hex() if computed is not None else "",
            )
        read = None if computed is None else self._read_command(computed)
        ours = self._volts(read[1] if read else (0,) * len(theirs))
        self._computed += sum(u * u for u in ours)
        differences = [abs(a - b) for a, b in zip(ours, theirs, strict=True)]
        self._square += sum(d * d for d in differences)
        self._largest = max(self._largest, *differences)

    def _volts(self, codes: Sequence[float]) -> list[float]:
        """What a plant makes of a command; 0 V of a code without a valid value."""
        return [volts if (volts := self._level(code)) == volts else 0.0 for code in codes]


def replay(
    paths: Sequence[Path], overrides: Sequence[str] = (), progress: Callable[[float], None] | None = None
) -> list[SessionReplay]:
    """Replay every session of a run.

    Args:
        paths: Logs, folders of logs, or a rotated run.
        overrides: `section.key=value`, to compute with another law instead of the logged one. An override of the gains
            or of the reference stands in for every change that the log has of them.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        ReviewError: It cannot be read, or has no controller's configuration.
        ConfigError: An override is wrong.
    """
    files = LogFiles(paths)
    settings = load_over(files.settings, overrides)
    own_gains = any(override.startswith("law.") for override in overrides)
    own_reference = any(override.startswith("reference") for override in overrides)

    def replayer(which: Which) -> Replayer:
        changes = files.changes.get(which, [])
        if own_gains:
            changes = [change.model_copy(update={"gains": None}) for change in changes]
        if own_reference:
            changes = [change.model_copy(update={"reference": None}) for change in changes]
        return Replayer(settings, changes)

    sessions = Sessions(replayer)
    for take, payload, published_ns in files.routed(sessions.route, progress):
        take(Seen(payload, published_ns))
    for session in sessions.values():
        session.finish()
    return [session.result(vehicle, name) for (vehicle, name), session in sessions.items()]
