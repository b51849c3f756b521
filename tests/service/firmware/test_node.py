"""The node in C is Python's, tick by tick: the same frames, heartbeats, voltages, states, causes and counts.

Both get the same frames and sensor values at the same times, from a controller's side with many troubles.
"""

from __future__ import annotations

import ctypes
import re
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from math import cos, nan, sin
from pathlib import Path
from queue import Empty, Queue
from random import Random
from typing import Any

import can
import pytest

from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.transport.can_format import LOCKSTEP_SILENT_S, SILENT_S, CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import LoopSettings, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Transmit
from aeroloop.service.config import Settings
from tests.support.clock import FakeClock
from tests.support.firmware import COMPILERS, NO_COMPILER, SOURCE, library
from tests.support.plant_end import RecordingPlant

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)

SUPPLY = 18.0

PORT = r"""
#include <string.h>
#include "aero_node.h"
#include "aero_port.h"
#define MANY 4096
struct frame { uint32_t id, size; uint8_t data[64]; } received[MANY], sent[MANY];
int64_t now, ticks[MANY];
int receives, taken, sends, actuations;
double reading[7], volts[MANY][AERO_ACTUATORS];
static aero_node node;
int64_t aero_port_now(void) { return now; }
void aero_port_actuate(int64_t k, const double v[AERO_ACTUATORS])
{
    ticks[actuations] = k;
    memcpy(volts[actuations++], v, sizeof *volts);
}
void aero_port_enable(int on) { (void)on; }
void aero_port_measure(int64_t k, double q[4], double w[3])
{
    (void)k;
    memcpy(q, reading, 4 * sizeof *q);
    memcpy(w, reading + 4, 3 * sizeof *w);
}
void aero_port_send(uint32_t id, const uint8_t *data, size_t size)
{
    sent[sends].id = id;
    sent[sends].size = (uint32_t)size;
    memcpy(sent[sends++].data, data, size);
}
int aero_port_receive(uint32_t *id, uint8_t data[64], size_t *size)
{
    if (taken == receives) { return 0; }
    *id = received[taken].id;
    *size = received[taken].size;
    memcpy(data, received[taken++].data, 64);
    return 1;
}
void start(void);
void turn(int64_t k, int *state, int *cause, int *refused, int *stale, double *voltages);
void start(void) { aero_start(&node); }
void turn(int64_t k, int *state, int *cause, int *refused, int *stale, double *voltages)
{
    sends = actuations = taken = 0;
    aero_poll(&node);
    if (AERO_LOCKSTEP) { aero_answered(&node); }
    aero_tick(&node, k);
    *state = node.state;
    *cause = node.cause;
    *refused = (int)node.refused;
    *stale = (int)node.stale;
    memcpy(voltages, node.voltages, sizeof node.voltages);
}
"""


class Frame(ctypes.Structure):
    """A CAN frame of the port above."""

    _fields_ = (("id", ctypes.c_uint32), ("size", ctypes.c_uint32), ("data", ctypes.c_uint8 * 64))


class Motors(RecordingPlant):
    """A plant that records the voltages of every period, clipped to the supply as an emulated one does."""

    def actuate(self, voltages: Sequence[float]) -> None:
        super().actuate([max(-SUPPLY, min(SUPPLY, volts)) for volts in voltages])


class ScriptedBus:
    """A bus whose frames are received when `deliver` returns, and which keeps what is sent."""

    def __init__(self, **_: Any) -> None:
        self._queue: Queue[can.Message] = Queue()
        self._busy = False
        self.sent: list[tuple[int, bytes]] = []

    def deliver(self, frames: list[tuple[int, bytes]]) -> None:
        for identifier, data in frames:
            self._queue.put(can.Message(arbitration_id=identifier, data=data, is_extended_id=False, is_fd=True))
        self._queue.join()

    def recv(self, timeout: float) -> can.Message | None:
        if self._busy:
            self._queue.task_done()
        self._busy = False
        with suppress(Empty):
            message = self._queue.get(timeout=timeout)
            self._busy = True
            return message
        return None

    def send(self, message: can.Message, timeout: float) -> None:
        assert timeout
        self.sent.append((message.arbitration_id, bytes(message.data)))

    def shutdown(self) -> None:
        pass


MOODS = ("good", "good", "good", "mute", "gone", "late", "no value", "garbled", "other wire", "idle", "another", "full",
         "blind", "tilted", "fast", "jumpy", "stuck")  # fmt: skip


class Controller:
    """The controller's side and the plant's motion: what is received before each tick, and what is measured then."""

    def __init__(self, settings: Settings, seed: int) -> None:
        wire, can_bus, loop = settings.wire, settings.can, settings.loop
        self._wire, self._node, self._random = wire, can_bus.node, Random(seed)
        self._mark = fingerprint(wire, loop.period_ns, lockstep=loop.lockstep)
        self._quantizer = wire.voltage.quantizer()
        self._silent_s = LOCKSTEP_SILENT_S if loop.lockstep else SILENT_S
        self._silent = loop.lockstep and wire.transmit.command == "on_change"
        self.mood, self._left, self._late, self._number, self._beat_due = "good", 0, 0, 0, 0
        self._echoes: deque[int] = deque(maxlen=300)
        self._angle = 0.0
        self._reading = Measurement((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._values: list[float] = [0.0] * wire.actuators

    def step(self) -> int:
        """Begin a tick; how many periods have passed since the last."""
        random = self._random
        self._left -= 1
        if self._left < 0:
            self.mood, self._left, self._late = random.choice(MOODS), random.randrange(2, 70), random.randrange(1, 40)
            if self.mood == "another" or random.random() < 0.8:  # else a trip would last
                self._number, self._beat_due = (self._number + 1) % 16, 0
        counters = self._wire.measurement.counters
        return random.choice((1, 1, 1, 2, 3, 11, counters - 1, counters)) if self.mood == "jumpy" else 1

    def pause_ns(self) -> int:
        """For how long the node is kept from its tick [ns]: so it notices silence before its watchdog does."""
        if self.mood != "gone" or self._random.random() >= 0.3:
            return 0
        return round((self._silent_s + 0.01) * 1e9)

    def frames(self, now_ns: int) -> list[tuple[int, bytes]]:
        """What the node receives before a tick."""
        found = [*self._heartbeats(now_ns), *self._commands()]
        if self._random.random() < 0.02:
            found.append((self._random.choice((0x101, 0x202, 0x201 + self._node, 0x381 + self._node)), bytes(3)))
        return found

    def sent(self, frames: list[tuple[int, bytes]]) -> None:
        """Take what the node sent."""
        for identifier, data in frames:
            if identifier == 0x100 + self._node:
                read = self._wire.measurement.unpack(data[: self._wire.measurement.size])
                silent = (self._echoes[-1] + 1) % self._wire.measurement.counters if self._echoes else 0
                self._echoes.append(read[0] if read else silent)

    def measure(self) -> Measurement:
        """Attitude and rate at a tick."""
        random = self._random
        if random.random() < 0.6 and self.mood != "stuck":
            self._angle += random.gauss(0, 0.05) - 0.03 * self._angle
            tilt = 1.6 if self.mood == "tilted" and random.random() < 0.05 else self._angle
            q = (cos(tilt / 2), sin(tilt / 2), 0.0, 0.0)
            sign = random.choice((1.0, -1.0))
            q = (sign * q[0], sign * q[1], sign * 0.0, sign * 0.0)
            fast = 21.0 if self.mood == "fast" and random.random() < 0.05 else random.gauss(0, 0.2)
            self._reading = Measurement(q, (random.gauss(0, 0.2), fast, random.gauss(0, 0.2)))
        blind = (self.mood == "blind" and random.random() < 0.97) or random.random() < 0.02
        return Measurement(self._reading.attitude, (nan, 0.0, 0.0)) if blind else self._reading

    def _heartbeats(self, now_ns: int) -> list[tuple[int, bytes]]:
        random, beat = self._random, 0x380 + self._node
        if self.mood == "gone" or now_ns < self._beat_due:
            return []
        self._beat_due = now_ns + random.randrange(40, 120) * 1_000_000
        state = random.choice(list(PlantState)) if self.mood == "idle" else PlantState.GRANTED
        mark = bytes(7) if self.mood == "other wire" else self._mark
        found = [(beat, Heartbeat(state, self._number, mark).pack())]
        if self.mood == "garbled":
            found.append((beat, random.choice((b"", bytes(7), bytes(9), b"\x04" + self._mark, b"\x1f" + self._mark))))
        return found

    def _commands(self) -> list[tuple[int, bytes]]:
        random, form, name = self._random, self._wire.command, 0x200 + self._node
        if self.mood in ("mute", "gone") or not self._echoes or random.random() < 0.1:
            return []
        if random.random() < 0.5:
            limit = self._quantizer.limit
            self._values = [random.uniform(-limit, limit) for _ in self._values]
        values = [self._quantizer.limit if self.mood == "full" else value for value in self._values]
        codes = [self._quantizer.encode(value) for value in values]
        if (self.mood == "no value" and random.random() < 0.3) or self.mood == "blind":
            codes = [self._quantizer.invalid] * len(codes)
        late = self._late if self.mood == "late" else random.choice((0, 0, 0, 1, 2))
        frame = form.pack(self._echoes[-min(late + 1, len(self._echoes))], codes)
        frame += bytes(next(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= len(frame)) - len(frame))
        if self.mood == "garbled":
            flipped = bytearray(frame)
            flipped[random.randrange(len(frame))] ^= 1 << random.randrange(8)
            frame = random.choice((frame, frame[:-1], frame + bytes(1), frame + bytes(8), b"", bytes(flipped)))
        if self._silent and random.random() < 0.4:
            frame = b""
        return [(name, frame)] * random.choice((1, 1, 1, 2))


def signal(kind: Any, bits: int | None, limit: float) -> SignalSpec:
    return SignalSpec(kind=kind, bits=bits, limit=limit)


CODED = (signal("hysteresis-uniform", 8, 1.0), signal("logarithmic-uniform", 9, 1.0), signal("uniform", 6, 24.0))
WIRES = {
    "periodic": (WireSpec(), False),
    "on change": (
        WireSpec(attitude=CODED[0], rate=CODED[1], transmit=Transmit(measurement="on_change", heartbeat_s=0.008)),
        False,
    ),
    "a counter of 4 bits, on change": (
        WireSpec(
            attitude=CODED[1],
            rate=CODED[1],
            actuators=1,
            counter_bits=4,
            transmit=Transmit(measurement="on_change", heartbeat_s=0.006),
        ),
        False,
    ),
    "CAN FD": (
        WireSpec(attitude=signal("uniform", None, 1.0), voltage=signal("uniform", None, 24.0), actuators=3),
        False,
    ),
    "lockstep": (WireSpec(attitude=CODED[0]), True),
    "lockstep on change": (
        WireSpec(attitude=CODED[0], transmit=Transmit(measurement="on_change", command="on_change")),
        True,
    ),
}


def settings_of(wire: WireSpec, *, lockstep: bool) -> Settings:
    plant = {
        "via": "can",
        "watchdog_s": 0.016,
        "voltage_limit": SUPPLY,
        "limits": {"max_saturated_s": 0.06, "max_invalid_s": 0.02},
    }
    return Settings.model_validate(
        {
            "wire": wire,
            "loop": LoopSettings(lockstep=lockstep),
            "plant": plant,
            "controller": {"stale_s": 0.016},
            "can": CanSettings(fd=True, node=5),
        }
    )


def test_states_and_causes_have_their_numbers() -> None:
    header = (SOURCE / "aero_node.h").read_text()
    states, causes, _ = (
        re.findall(r"AERO_(\w+)", each) for each in re.findall(r"^enum \{(.+?)\};", header, re.M | re.S)
    )
    assert states == [each.name for each in PlantState]
    assert causes == ["NO_CAUSE", *(each.name for each in TripCause)]


@pytest.mark.parametrize("name", WIRES)
def test_the_node_in_c_does_what_the_node_in_python_does(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("CRITICAL")
    wire, lockstep = WIRES[name]
    settings = settings_of(wire, lockstep=lockstep)
    (tmp_path / "port.c").write_text(PORT)
    c = library(settings, tmp_path, *(SOURCE / f"aero_{part}.c" for part in ("wire", "node")), tmp_path / "port.c")
    now = ctypes.c_int64.in_dll(c, "now")
    received, sent = ((Frame * 4096).in_dll(c, each) for each in ("received", "sent"))
    receives, sends, actuations = (ctypes.c_int.in_dll(c, each) for each in ("receives", "sends", "actuations"))
    reading = (ctypes.c_double * 7).in_dll(c, "reading")
    volts = (ctypes.c_double * wire.actuators * 4096).in_dll(c, "volts")
    ticks = (ctypes.c_int64 * 4096).in_dll(c, "ticks")
    state, cause, refused, stale = (ctypes.c_int() for _ in range(4))
    commanded = (ctypes.c_double * wire.actuators)()

    clock, bus, plant = FakeClock(), ScriptedBus(), Motors(wire.actuators)
    monkeypatch.setattr("aeroloop.protocol.transport.can_link.time", clock)
    monkeypatch.setattr("aeroloop.protocol.transport.can_link.can.Bus", lambda **_: bus)
    endpoint = settings.plant.endpoint(plant, settings.loop, wire)
    at_motors = plant.voltages  # of the node in C
    front = CanNetwork(settings.can, settings.loop, endpoint)
    controller, k, seen = Controller(settings, seed=1), -1, Counter[Outcome]()
    c.start()
    for _ in range(8000):
        periods = 1 if k < 0 else controller.step()
        k += periods
        clock.now_ns += periods * 2_037_011 + controller.pause_ns()  # so that heartbeats fall on no tick
        frames, measured = controller.frames(clock.now_ns), controller.measure()

        bus.sent.clear()
        plant.periods.clear()
        plant.now = measured
        bus.deliver(frames)
        front.take_inbox()
        arrival = front.link.take() if front.link else None
        if lockstep and arrival and wire.command.counter(arrival.frame) not in (endpoint.counter, None):
            arrival = None  # as the driver, which waits for the answer to the last measurement
        endpoint.tick(arrival.frame if arrival else None, k)
        for each in endpoint.outgoing:
            if (each or lockstep) and front.link:
                front.link.send(each)
        front.after_tick(None, None, 0)

        now.value, receives.value = clock.now_ns, len(frames)
        for i, (identifier, data) in enumerate(frames):
            received[i] = Frame(identifier, len(data), (ctypes.c_uint8 * 64)(*data))
        reading[:] = [*measured.attitude, *measured.rate]
        c.turn(ctypes.c_int64(k), *map(ctypes.byref, (state, cause, refused, stale)), commanded)

        assert [(each.id, bytes(each.data[: each.size])) for each in sent[: sends.value]] == bus.sent
        assert list(PlantState)[state.value] is endpoint.state
        assert cause.value == (endpoint.trip.number if endpoint.trip else 0)
        assert tuple(commanded) == endpoint.voltages
        in_force: list[tuple[float, ...]] = []  # the voltages that the node in C had in force
        first_period = k - len(plant.periods)
        for i in range(actuations.value):
            passed = ticks[i] - first_period
            in_force += [at_motors] * (passed - len(in_force))
            at_motors = tuple(volts[i])
        in_force += [at_motors] * (len(plant.periods) - len(in_force))
        assert in_force == plant.periods
        assert at_motors == plant.voltages
        controller.sent(bus.sent)
        assert stale.value == endpoint.stale
        if isinstance(front.link, CanLink):
            assert refused.value == endpoint.refused + front.link.refused
        seen[endpoint.outcome] += 1
    expected = {
        TripCause.COMMAND_TIMEOUT,
        TripCause.INVALID_COMMAND,
        TripCause.ENVELOPE,
        TripCause.SATURATION,
        TripCause.SENSORS,
        TripCause.HOLDER_GONE,
    }
    assert set(endpoint.trips) == expected
    assert set(seen) >= {Outcome.ACTED, Outcome.NONE, Outcome.INVALID}
    assert refused.value > 0
