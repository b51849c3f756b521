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

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from protocol.messages import Lapse, Telemetry
from protocol.verbs import Change
from protocol.wire import SignalSpec
from service.config import Settings, load_over
from service.figures import added, squares
from service.logs.batch import BatchController
from service.logs.codes import codes_in, levels
from service.logs.files import LogFiles, Which
from service.logs.filling import Read
from service.logs.pairing import MAX_WAITING, Pairing, Sessions, without_collections
from service.logs.report import Array
from service.logs.tallies import BLOCK

Pair = tuple[int, Read, Read]
"""A tick, its measurement and the command that answered it."""


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
        lapses: Where it did not compute with the plant's levels.
    """

    def __init__(self, settings: Settings, changes: Sequence[Change], lapses: Sequence[Lapse] = ()) -> None:
        super().__init__(settings.wire, settings.loop, lapses)
        self._controller = BatchController(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._changes = deque(changes)
        self._period = settings.loop.period
        self._begun = False
        self._unplaced: deque[Telemetry] = deque(maxlen=MAX_WAITING)
        self._held: deque[Pair] = deque(maxlen=MAX_WAITING)  # until it is known where to begin
        self._waiting: list[Pair] = []  # to be computed as a block
        self.first_tick: int | None = None
        self.first_difference: Difference | None = None
        self.commands = self.differing = 0
        self._square = self._largest = self._logged = self._computed = 0.0

    @property
    def wants_telemetry(self) -> bool:
        """Until it is known where to begin."""
        return not self._begun

    def measured(self, frame: bytes, published_ns: int) -> None:
        """Only what was answered is computed again."""

    def commanded(self, frame: bytes) -> None:
        """Only what answers is compared."""

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """Compute the command of tick k again."""
        if not self._begun:
            self._held.append((k, measurement, command))
            return
        self._waiting.append((k, measurement, command))
        if len(self._waiting) >= BLOCK:
            self._compute()

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
        self._compute()

    def _begin(self, telemetry: Telemetry) -> None:
        tick = telemetry.tick
        held = next((pair for pair in self._held if pair[0] == tick), None)
        if held is None:
            return
        controller, told = self._controller, (telemetry.sign, telemetry.damping_estimate)
        codes = codes_in(self._wire.measurement, [held[1].frame])
        computed = controller.compute_all(np.array([tick]), codes, self._changes)
        now = controller.state
        same = tuple(computed.attitude_error[0].tolist()) == telemetry.attitude_error
        if held is self._held[0] and same and told == (now.sign, now.damping_estimate):
            self.first_tick = tick  # the session's very first: nothing had been computed before it
            self._compare([held], computed.voltages)
        else:
            w, x, y, z = now.attitude
            if float(computed.attitude_error[0] @ telemetry.attitude_error) < 0:  # it followed −q
                w, x, y, z = -w, -x, -y, -z
            logged = self._logged_codes([pair for pair in self._held if pair[0] <= tick])
            valid = logged[~np.isnan(levels(self._wire.voltage, logged)).any(axis=1)][-1:].tolist()
            encoded = tuple(valid[0]) if valid else None
            update = {"sign": told[0], "damping_estimate": told[1], "attitude": (w, x, y, z), "voltage_codes": encoded}
            controller.restore(now.model_copy(update=update))
            self.first_tick = tick + 1
        self._begun = True
        self._waiting += [pair for pair in self._held if pair[0] > tick]
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

    def _compute(self) -> None:
        """Compute the commands that wait again, and compare them."""
        pairs, self._waiting = self._waiting, []
        if pairs:
            self._compare(pairs, self._voltages(pairs))

    def _voltages(self, pairs: Sequence[Pair]) -> Array:
        """What the law commands at the next ticks [V]; NaN for no valid value. Shape (n, actuators)."""
        codes = codes_in(self._wire.measurement, [measurement.frame for _, measurement, _ in pairs])
        return self._controller.compute_all(np.array([k for k, _, _ in pairs]), codes, self._changes).voltages

    def _compare(self, pairs: Sequence[Pair], voltages: Array) -> None:
        """Compare logged commands with what the law commands."""
        signal, ours = self._wire.voltage, self._controller.commands(np.array([k for k, *_ in pairs]), voltages).codes
        theirs = self._logged_codes(pairs)
        differ = np.flatnonzero((ours.view(np.int64) != theirs.view(np.int64)).any(axis=1))  # an echo cannot differ
        if len(differ) and self.first_difference is None:
            k, measurement, command = pairs[differ[0]]
            codes = [int(code) if signal.bits else code for code in ours[differ[0]].tolist()]
            self.first_difference = Difference(
                tick=k,
                time_s=round(k * self._period, 9),
                logged=command.frame.hex(),
                computed=self._wire.command.pack(measurement.counter, codes).hex(),
            )
        self.commands += len(pairs)
        self.differing += len(differ)
        ours, theirs = _volts(signal, ours), _volts(signal, theirs)
        self._logged = added(self._logged, squares(theirs))
        self._computed = added(self._computed, squares(ours))
        self._square = added(self._square, squares(ours - theirs))
        self._largest = max(self._largest, float(np.abs(ours - theirs).max()))

    def _logged_codes(self, pairs: Sequence[Pair]) -> Array:
        return codes_in(self._wire.command, [command.frame for _, _, command in pairs])


def _volts(signal: SignalSpec, codes: Array) -> Array:
    """What a plant makes of commands; 0 V of a code without a valid value."""
    volts = levels(signal, codes)
    return np.where(np.isnan(volts), 0.0, volts)


@without_collections()
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
        return Replayer(settings, changes, files.lapses.get(which, ()))

    sessions = Sessions(replayer)
    for take, payload, published_ns in files.routed(sessions.route, progress):
        take(payload, published_ns)
    for session in sessions.values():
        session.finish()
    return [session.result(vehicle, name) for (vehicle, name), session in sessions.items()]
