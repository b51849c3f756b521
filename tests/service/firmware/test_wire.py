"""The wire in C is Python's, bit for bit: quantizers, frames, transmit policy."""

from __future__ import annotations

import ctypes
import struct
from dataclasses import dataclass
from itertools import pairwise
from math import inf, nan, nextafter
from pathlib import Path
from random import Random
from typing import Any

import pytest

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, Quantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import LoopSettings, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Sender, Transmit
from aeroloop.service.config import Settings
from tests.support.firmware import COMPILERS, NO_COMPILER, SOURCE, library

SIGNALS = ("attitude", "rate", "voltage")
SPECS: dict[str, Any] = {
    "the paper's": ("uniform 8", "uniform 8", "uniform 6", 2, 8, 15),
    "coarse": ("uniform 2", "logarithmic-uniform 3", "hysteresis-uniform 2", 1, 4, 3),
    "fine": ("logarithmic-uniform 16", "hysteresis-uniform 16", "uniform 16", 8, 16, 2),
    "odd": ("hysteresis-uniform 7 hysteresis=0.1", "uniform 11 deadzone=0.3", "logarithmic-uniform 13", 5, 9, 1),
    "continuous": ("uniform 0", "uniform 0", "uniform 0", 3, 8, 5),
    "mixed": ("uniform 0", "hysteresis-uniform 9", "uniform 0", 2, 5, 15),
    "wide": (
        *("hysteresis-uniform 10", "logarithmic-uniform 10 threshold=0.5 deadzone=0.01"),
        *("hysteresis-uniform 6 deadzone=0.2 hysteresis=0.4", 2, 4, 7),
    ),
}
"""ε, ω, u as kind, bits and lengths in parts of the limit; actuators; counter bits; heartbeat in ticks of 50 ms."""

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)


@dataclass
class Wire:
    """A wire in Python and in C."""

    spec: WireSpec
    c: ctypes.CDLL
    heartbeat: int

    def quantizers(self) -> list[tuple[Quantizer, Any]]:
        names = {name: ctypes.c_char.in_dll(self.c, f"aero_{name}") for name in SIGNALS}
        return [(getattr(self.spec, name).quantizer(), ctypes.byref(symbol)) for name, symbol in names.items()]

    def frames(self) -> list[tuple[FrameFormat, Any, Any]]:
        return [
            (getattr(self.spec, name), getattr(self.c, f"aero_pack_{name}"), getattr(self.c, f"aero_unpack_{name}"))
            for name in ("measurement", "command")
        ]


BUILDS = [(name, compiler) for compiler in COMPILERS for name in (SPECS if compiler == COMPILERS[0] else [*SPECS][:1])]


@pytest.fixture(params=BUILDS, ids=", ".join)
def wire(request: pytest.FixtureRequest, tmp_path: Path) -> Wire:
    name, compiler = request.param
    *signals, actuators, counter_bits, heartbeat = SPECS[name]
    fields: dict[str, Any] = {}
    for signal, limit, (kind, bits, *parts) in zip(SIGNALS, (1.0, 0.7, 24.0), map(str.split, signals), strict=True):
        lengths: dict[str, Any] = {name: float(part) * limit for name, part in (each.split("=") for each in parts)}
        fields[signal] = SignalSpec(bits=int(bits) or None, limit=limit, **lengths | {"kind": kind})
    spec = WireSpec(
        **fields, actuators=actuators, counter_bits=counter_bits, transmit=Transmit(heartbeat_s=heartbeat / 20)
    )
    settings = Settings(wire=spec, loop=LoopSettings(rate_hz=20))
    c = library(settings, tmp_path, SOURCE / "aero_wire.c", compiler=compiler)
    c.aero_encode.restype = c.aero_level.restype = c.aero_no_value.restype = ctypes.c_double
    c.aero_encode.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double]
    c.aero_level.argtypes = c.aero_saturates.argtypes = [ctypes.c_void_p, ctypes.c_double]
    c.aero_due.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int]
    return Wire(spec, c, heartbeat)


def bits_of(value: float) -> bytes:
    return struct.pack(">d", value)


def edges_of(quantizer: Quantizer) -> list[float]:
    """Where the code changes, but for a hysteresis whose held code is at one of the ends."""
    if isinstance(quantizer, LogarithmicQuantizer):
        return quantizer.edges
    if not isinstance(quantizer, UniformQuantizer):
        return [quantizer.limit]
    edges = [quantizer.deadzone + i * quantizer.step for i in range(quantizer.top + 1)]
    if isinstance(quantizer, HysteresisQuantizer):
        edges += [edge + sign * quantizer.hysteresis for edge in edges for sign in (-1, 1)]
    return edges


def values_for(quantizer: Quantizer, random: Random) -> list[float]:
    """Values about edges, values anywhere, and odd ones, in an order of their own, and steps between neighbours."""
    near = []
    for edge in random.sample(edges := edges_of(quantizer), min(len(edges), 200)):
        for ulps in (-9, -4, -3, -2, -1, 0, 1, 2, 3, 4, 9):
            value = edge
            for _ in range(abs(ulps)):
                value = nextafter(value, inf if ulps > 0 else -inf)
            near.append(value * random.choice((-1, 1)))
    anywhere = [random.uniform(-1.3, 1.3) * quantizer.limit for _ in range(500)]
    odd = [0.0, -0.0, 5e-324, -5e-324, 1e300, -1e300, inf, -inf, quantizer.limit, -quantizer.limit]
    walk = [value * (1 + random.gauss(0, 0.02)) for value in random.sample(anywhere, 100) for _ in range(8)]
    return [*walk, *random.sample(mixed := [*near, *anywhere, *odd], len(mixed))]


def test_codes_levels_and_saturation_are_those_of_python(wire: Wire) -> None:
    random = Random(1)
    for quantizer, c in wire.quantizers():
        assert bits_of(wire.c.aero_no_value(c)) == bits_of(quantizer.invalid)
        assert bits_of(wire.c.aero_level(c, quantizer.invalid)) == bits_of(quantizer.level(quantizer.invalid))
        held = nan
        for value in values_for(quantizer, random):
            before = quantizer.saturated
            code, held = quantizer.encode(value), wire.c.aero_encode(c, value, held)
            assert bits_of(held) == bits_of(code), (value, code, held)
            assert wire.c.aero_saturates(c, value) == quantizer.saturated - before, value
            assert bits_of(wire.c.aero_level(c, code)) == bits_of(quantizer.level(code)), code
        assert bits_of(wire.c.aero_encode(c, nan, held)) == bits_of(quantizer.invalid)
        if (top := getattr(quantizer, "top", None)) is not None:
            assert {wire.c.aero_level(c, code) for code in range(-top, top + 1)} == {
                quantizer.level(code) for code in range(-top, top + 1)
            }
            assert all(bits_of(wire.c.aero_level(c, code)) == bits_of(nan) for code in (top + 1, -top - 2, nan, inf))


def test_frames_are_those_of_python_and_what_it_refuses_is_refused(wire: Wire) -> None:
    random, found = Random(2), {"read": 0, "refused": 0}
    for form, pack, unpack in wire.frames():
        counter, codes, frame = ctypes.c_uint32(), (ctypes.c_double * 8)(), (ctypes.c_uint8 * form.size)()
        for _ in range(1500):
            sent = [
                random.choice([random.uniform(-2, 2), 0.0, -0.0, nan, 5e-324])
                if width is None
                else random.choice([random.randrange(-(2 ** (width - 1)), 2 ** (width - 1)), -(2 ** (width - 1)), 0])
                for width in form.widths
            ]
            number = random.randrange(form.counters)
            pack(frame, ctypes.c_uint32(number), (ctypes.c_double * 8)(*sent))
            assert bytes(frame) == form.pack(number, sent)
            received = bytearray(frame)
            for _ in range(random.randrange(3)):  # flipped bits, in padding and in the exponent of a float as well
                received[random.randrange(form.size)] ^= 1 << random.randrange(8)
            if form.size > 8 and random.random() < 0.2:
                received[form.first_bit // 8 : form.first_bit // 8 + 8] = bits_of(random.choice((inf, -inf)))
            received = received[: random.choice([form.size] * 8 + [0, form.size - 1])]
            received += bytes(random.choice([0] * 8 + [1]))
            untouched = [7.5] * 8
            codes[:] = untouched  # type: ignore[assignment]  # floats become C's
            read = form.unpack(bytes(received))
            assert unpack(bytes(received), ctypes.c_size_t(len(received)), ctypes.byref(counter), codes) == (
                read is not None
            )
            if read is None:
                assert codes[:] == untouched
            else:
                assert counter.value == read[0]
                assert list(map(bits_of, codes[: len(sent)])) == list(map(bits_of, read[1]))
            found["refused" if read is None else "read"] += 1
    assert min(found.values()) > 100


def test_frames_are_due_when_python_sends_them(wire: Wire) -> None:
    random, count = Random(3), len(wire.spec.measurement.widths)
    counters = wire.spec.measurement.counters
    sender, memory = Sender("on_change", wire.heartbeat, counters), ctypes.create_string_buffer(1024)
    kinds: list[float] = [0.0, -0.0, nan, -nan, 1.0]
    codes, k, sent = [0.0] * count, 0, []
    for _ in range(4000):
        if random.random() < 0.4:
            codes = [*codes]
            codes[random.randrange(count)] = random.choice(kinds)
        if random.random() < 0.01:
            sender.forget()
            wire.c.aero_forget(memory)
        due = sender.due(k, codes)
        values = (ctypes.c_double * count)(*codes)
        assert wire.c.aero_due(memory, 1, k, values, count) == due, k
        assert wire.c.aero_due(memory, 0, k, values, count)
        sent.append(due)
        k += random.choice([1] * 20 + [2, 3, counters - 1, counters, 2 * counters])
    assert 0 < sum(sent) < len(sent) or wire.heartbeat == 1
    assert any(not a and b for a, b in pairwise(sent)) or wire.heartbeat == 1
