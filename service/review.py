"""The review: every figure, from a log alone.

The log holds the configuration (in the roles' contracts) and the frames, so the review decodes each measurement as the
controller did, with the controller's own code, and asks it for the error. A measurement counts once a command has
answered it or a later one: what the controller never used, it does not answer for.

The law's tick is not in a frame, only its counter modulo 16. Telemetry says both now and then, and the session's first
tick always; from there the counter is unwrapped, over gaps with the help of the times of publication. Those times also
say which measurement a command answers: the latest before it that had its echo for a counter, as for the plant.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from pydantic import ValidationError
from zstandard import ZstdError

from protocol import topics
from protocol.attitude import Quaternion, Vector
from protocol.errors import AeroloopError
from protocol.frames import COUNTERS, TickCounter
from protocol.messages import Contract, Event, Percentiles, Status, Telemetry
from protocol.verbs import Change
from service.config import ConfigError, Settings, from_contract
from service.controller import Controller
from service.figures import Figures, Score
from service.recorder import CONTRACT_METADATA, read_contract

MAX_WAITING: Final = 4096
"""Measurements kept while no telemetry has yet said which tick they are."""


class ReviewError(AeroloopError):
    """A log cannot be judged; one line that says why."""


class Seen(NamedTuple):
    """A frame out of the log."""

    frame: bytes
    published_ns: int


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


class Session:
    """One session's frames, scored as they are read.

    Args:
        settings: The configuration of its controller.
        changes: What its controller followed from which tick on, in order.
        keep: Whether to keep every tick, for figures.
    """

    def __init__(self, settings: Settings, changes: Sequence[Change] = (), *, keep: bool = False) -> None:
        self.settings = settings
        self._changes = deque(changes)
        self._wire = settings.wire
        self._controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        self._level = settings.wire.voltage.quantizer().level
        self._waiting: deque[Seen] = deque(maxlen=MAX_WAITING)  # measurements whose tick is not known yet
        self._anchors: deque[tuple[Telemetry, int]] = deque(maxlen=MAX_WAITING)  # and what could tell it
        self._commands: deque[Seen] = deque(maxlen=MAX_WAITING)  # commands whose measurement may still be to come
        self._measured: deque[tuple[int, Seen]] = deque()  # measurements that no command has answered yet
        self._ticks: TickCounter | None = None  # once it is known where it starts
        self.malformed = 0
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)
        self.ticks: list[Tick] | None = [] if keep else None

    def measurement(self, seen: Seen) -> None:
        """A measurement frame; commands that were published before it can now be told which tick they answer."""
        counter = self._counter(seen)
        if counter is None:
            self.malformed += 1
        elif self._ticks is None:
            self._waiting.append(seen)
            self._anchor(seen.published_ns)
        else:
            self._answer(seen.published_ns)
            if (k := self._ticks.advance(counter, seen.published_ns)) is not None:
                self._measured.append((k, seen))

    def command(self, seen: Seen) -> None:
        """A command frame. The recorder has it from another link than the measurements, so it may come before them."""
        self._commands.append(seen)

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """Which tick a counter stood for; the first that can be matched tells it for the whole session."""
        if self._ticks is None:
            self._anchors.append((telemetry, published_ns))

    def finish(self) -> None:
        """No more is to come: what still waits is judged by what there is."""
        self._anchor(None)
        self._answer(None)

    def _anchor(self, until_ns: int | None) -> None:
        """Match telemetry from before `until_ns` with the latest measurement before it that had its counter."""
        while self._ticks is None and self._anchors and (until_ns is None or self._anchors[0][1] < until_ns):
            telemetry, published_ns = self._anchors.popleft()
            waiting = list(self._waiting)
            for i in reversed(range(len(waiting))):
                if waiting[i].published_ns < published_ns and self._counter(waiting[i]) == telemetry.counter:
                    self._waiting.clear()
                    loop = self.settings.loop
                    first = self._first_tick(waiting[: i + 1], telemetry.tick)
                    self._ticks = TickCounter(loop.period_ns, lockstep=loop.lockstep, tick=first - 1)
                    for seen in waiting:
                        self.measurement(seen)
                    break
            # else: the measurement that it speaks of came before the log began

    def _answer(self, until_ns: int | None) -> None:
        """Score the commands published before `until_ns`, each with the latest measurement before it of its echo.

        Zenoh's timestamps are hybrid logical clocks: an answer is always stamped later than its question, on any host.
        """
        while self._commands and (until_ns is None or self._commands[0].published_ns < until_ns):
            seen = self._commands.popleft()
            read = self._wire.command.unpack(seen.frame)
            if read is None:
                self.malformed += 1
                continue
            echo, codes = read
            answered = next(
                (
                    k
                    for k, measured in reversed(self._measured)
                    if k % COUNTERS == echo and measured.published_ns < seen.published_ns
                ),
                None,
            )
            if answered is None:
                continue  # answers what the log does not have, or repeats an answer
            voltages = [self._level(code) for code in codes]
            while self._measured and self._measured[0][0] <= answered:
                self._score(*self._measured.popleft(), voltages)
            self.score.command(answered, voltages)

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

    def _counter(self, seen: Seen) -> int | None:
        read = self._wire.measurement.unpack(seen.frame)
        return None if read is None else read[0]

    def _first_tick(self, frames: list[Seen], tick: int) -> int:
        """The tick of the first of some measurements, the last of which is at `tick`, by counting down."""
        for seen in reversed(frames[:-1]):
            counter = self._counter(seen)
            assert counter is not None  # malformed ones never get here
            tick -= (tick - counter) % COUNTERS or COUNTERS
        return max(0, tick)


class Review(NamedTuple):
    """What a log says: figures of its longest session, and that session."""

    figures: Figures
    session: Session


def review(path: Path) -> Figures:
    """Judge a log: the figures of its longest session. Raises ReviewError as `read` does."""
    return read(path).figures


def read(path: Path, *, keep: bool = False) -> Review:
    """Read a log and judge its longest session.

    Args:
        path: The log.
        keep: Whether to keep every tick of every session, for figures.

    Raises:
        ReviewError: Not a log, a broken one, or one without a session.
    """
    sessions: dict[tuple[str, str], Session] = {}
    statuses: dict[tuple[str, str], Status] = {}
    trips: list[str] = []
    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            settings = _settings(reader, path)
            changes = _changes(reader)
            for address, payload, published_ns in _messages(reader):
                if address.session is not None:
                    which = address.vehicle, address.session
                    if which not in sessions:
                        sessions[which] = Session(settings, changes.get(which, ()), keep=keep)
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
    for session in sessions.values():
        session.finish()
    vehicle, name = max(sessions, key=lambda which: sessions[which].score.ticks)
    ends = {role: status for (of, role), status in statuses.items() if of == vehicle}
    longest = sessions[vehicle, name]
    return Review(_judge(longest, ends, path, trips), longest)


def _messages(reader: McapReader) -> Iterator[tuple[topics.Address, bytes, int]]:
    addresses: dict[str, topics.Address | None] = {}
    for _, channel, message in reader.iter_messages():
        key = channel.topic
        if key not in addresses:
            addresses[key] = topics.read_key(key)
        address = addresses[key]
        if address is not None:
            yield address, message.data, message.publish_time


def _changes(reader: McapReader) -> dict[tuple[str, str], list[Change]]:
    """What controllers followed, by vehicle and session: read first, since a command may overtake its own change."""
    changes: dict[tuple[str, str], list[Change]] = {}
    summary = reader.get_summary()
    keys = [channel.topic for channel in summary.channels.values()] if summary else []
    addresses = {key: address for key in keys if (address := topics.read_key(key)) and address.topic.name == "change"}
    if addresses:
        for _, channel, message in reader.iter_messages(topics=list(addresses)):
            change = Change.model_validate_json(message.data)
            changes.setdefault((addresses[channel.topic].vehicle, change.session), []).append(change)
    return changes


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


def _judge(session: Session, ends: dict[str, Status], path: Path, trips: list[str]) -> Figures:
    reasons: dict[str, str] = {}
    latency: Percentiles | None = ends["plant"].latency_us if "plant" in ends else None
    if latency is None:
        reasons["latency_us"] = "the log has no status of the plant with a latency"
    return session.score.figures(latency=latency, log=str(path), trips=trips, reasons=reasons)
