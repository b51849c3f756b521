"""The review: every figure, from a log alone.

The log holds the configuration (in the roles' contracts) and the frames, so the review decodes each measurement as the
controller did, with the controller's own code, and asks it for the error. A measurement counts once a command has
answered it or a later one: what the controller never used, it does not answer for.

The law's tick is not in a frame, only its counter modulo 16. Telemetry says both now and then, and the session's first
tick always; from there the counter is unwrapped, over gaps with the help of the times of publication.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from pydantic import ValidationError
from zstandard import ZstdError

from protocol import topics
from protocol.frames import COUNTERS
from protocol.messages import Contract, Percentiles, Status, Telemetry
from service.config import ConfigError, Settings, from_contract
from service.controller import Controller
from service.figures import Figures, Score
from service.recorder import CONTRACT_METADATA, read_contract
from service.reference import reference_function

MAX_WAITING: Final = 4096
"""Measurements kept while no telemetry has yet said which tick they are."""


class ReviewError(Exception):
    """A log cannot be judged; one line that says why."""


class Seen(NamedTuple):
    """A frame out of the log."""

    frame: bytes
    published_ns: int


class Session:
    """One session's frames, scored as they are read."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._wire = settings.wire
        self._period_ns = settings.loop.period_ns
        self._controller = Controller(
            settings.wire, settings.law, reference_function(settings.reference), settings.loop.period
        )
        self._level = settings.wire.voltage.quantizer().level
        self._waiting: deque[Seen] = deque(maxlen=MAX_WAITING)  # measurements whose tick is not known yet
        self._early: deque[Seen] = deque(maxlen=MAX_WAITING)  # commands to them
        self._unanswered: deque[tuple[int, bytes]] = deque()
        self._ahead: deque[Seen] = deque()  # commands that the log has before the measurement they answer
        self._last: tuple[int, int] | None = None  # tick and time of the last measurement
        self.malformed = 0
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)

    def measurement(self, seen: Seen) -> None:
        """A measurement frame."""
        read = self._wire.measurement.unpack(seen.frame)
        if read is None:
            self.malformed += 1
        elif self._last is None:
            self._waiting.append(seen)
        else:
            tick, time_ns = self._last
            k = self._unwrap(read[0], tick, seen.published_ns - time_ns)
            if k > tick:
                self._last = k, seen.published_ns
                self._unanswered.append((k, seen.frame))
                ahead, self._ahead = self._ahead, deque()
                for command in ahead:
                    self.command(command)

    def command(self, seen: Seen) -> None:
        """A command frame: it and the measurements up to the one it answers now count."""
        if self._last is None:
            self._early.append(seen)
            return
        read = self._wire.command.unpack(seen.frame)
        if read is None:
            self.malformed += 1
            return
        echo, codes = read
        answered = next((k for k, _ in reversed(self._unanswered) if k % COUNTERS == echo), None)
        if answered is None:
            # Two links to the recorder keep no order between them. Past half a round the measurement is not coming.
            if self._last is not None and len(self._ahead) < COUNTERS // 2:
                self._ahead.append(seen)
            return
        while self._unanswered and self._unanswered[0][0] <= answered:
            k, frame = self._unanswered.popleft()
            self._controller.tick(frame, k)
            if self._controller.tick_index == k:
                self.score.error(k, self._controller.attitude_error)
        voltages = [self._level(code) for code in codes]
        self.score.command(answered, [0.0 if u != u else u for u in voltages])

    def telemetry(self, telemetry: Telemetry) -> None:
        """The first one tells which tick the measurements so far belong to."""
        if self._last is not None:
            return
        waiting = list(self._waiting)
        found = next((i for i in reversed(range(len(waiting))) if self._counter(waiting[i]) == telemetry.counter), None)
        if found is None:
            return  # the measurement that it speaks of came before the log began
        self._waiting.clear()
        self._last = telemetry.tick, waiting[found].published_ns
        earlier = self._backwards(waiting[: found + 1], telemetry.tick)
        self._unanswered.extend(earlier)
        for seen in waiting[found + 1 :]:
            self.measurement(seen)
        commands, self._early = self._early, deque()
        for seen in commands:
            self.command(seen)

    def _counter(self, seen: Seen) -> int | None:
        read = self._wire.measurement.unpack(seen.frame)
        return None if read is None else read[0]

    def _backwards(self, frames: list[Seen], tick: int) -> list[tuple[int, bytes]]:
        """Ticks of measurements that came before a known one, counted down."""
        known: list[tuple[int, bytes]] = [(tick, frames[-1].frame)]
        for seen in reversed(frames[:-1]):
            counter = self._counter(seen)
            assert counter is not None  # malformed ones never get here
            k = known[-1][0] - ((known[-1][0] - counter) % COUNTERS or COUNTERS)
            if k < 0:
                break
            known.append((k, seen.frame))
        return known[::-1]

    def _unwrap(self, counter: int, tick: int, elapsed_ns: int) -> int:
        """The tick with this counter that is nearest to where the time of publication puts it, after `tick`."""
        step = (counter - tick) % COUNTERS
        if self._settings.loop.lockstep:
            return tick + step
        rounds = round((elapsed_ns / self._period_ns - step) / COUNTERS)
        return tick + step + max(0, rounds) * COUNTERS


def review(path: Path) -> Figures:
    """The figures of a log's longest session.

    Raises:
        ReviewError: Not a log, a broken one, or one without a session.
    """
    sessions: dict[tuple[str, str], Session] = {}
    statuses: dict[tuple[str, str], Status] = {}
    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            settings = _settings(reader, path)
            for address, payload, published_ns in _messages(reader):
                if address.session is not None:
                    which = address.vehicle, address.session
                    if which not in sessions:
                        sessions[which] = Session(settings)
                    seen = Seen(payload, published_ns)
                    if address.topic.name == "measurement":
                        sessions[which].measurement(seen)
                    else:
                        sessions[which].command(seen)
                elif address.topic.name == "telemetry":
                    telemetry = Telemetry.model_validate_json(payload)
                    if session := sessions.get((address.vehicle, telemetry.session)):
                        session.telemetry(telemetry)
                elif address.topic.name == "status" and address.role is not None:
                    statuses[address.vehicle, address.role] = Status.model_validate_json(payload)
    except OSError as error:
        raise ReviewError(f"cannot read {path}: {error.strerror}") from None
    except (McapError, struct.error, ZstdError, ValidationError, ConfigError) as error:
        raise ReviewError(
            f"{path} is not a whole aeroloop log: {(str(error) or type(error).__name__).splitlines()[0]}"
        ) from None
    if not sessions:
        raise ReviewError(f"{path} holds no session: no measurement or command frame was recorded")
    vehicle, name = max(sessions, key=lambda which: sessions[which].score.ticks)
    ends = {role: status for (of, role), status in statuses.items() if of == vehicle}
    return _judge(sessions[vehicle, name], ends, path)


def _messages(reader: McapReader) -> Iterator[tuple[topics.Address, bytes, int]]:
    addresses: dict[str, topics.Address | None] = {}
    for _, channel, message in reader.iter_messages():
        key = channel.topic
        if key not in addresses:
            addresses[key] = topics.read_key(key)
        address = addresses[key]
        if address is not None:
            yield address, message.data, message.publish_time


def _settings(reader: McapReader, path: Path) -> Settings:
    """The controller's configuration if the log has it, else the plant's."""
    contracts: dict[str, Contract] = {}
    for metadata in reader.iter_metadata():
        if metadata.name == CONTRACT_METADATA:
            contract = read_contract(metadata.metadata["json"])
            contracts[contract.role] = contract
    for role in ("controller", "plant"):
        if role in contracts:
            return from_contract(contracts[role].config)
    raise ReviewError(f"{path} has no contract of a controller or a plant, so its frames cannot be read")


def _judge(session: Session, ends: dict[str, Status], path: Path) -> Figures:
    reasons: dict[str, str] = {}
    latency: Percentiles | None = ends["plant"].latency_us if "plant" in ends else None
    if latency is None:
        reasons["latency_us"] = "the log has no status of the plant with a latency"
    return session.score.figures(latency=latency, log=str(path), reasons=reasons)
