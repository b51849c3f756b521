"""A block of ticks is computed to the very bits that the controller computes a tick at a time, however it is cut."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from protocol.attitude import IDENTITY, Quaternion, received_quaternion
from protocol.frames import FrameFormat
from protocol.logarithmic import LogarithmicQuantizer
from protocol.quantizer import CodedQuantizer
from protocol.verbs import Change, Gains, Hold, Points, Reference, Sinusoid
from protocol.wire import Kind, SignalSpec
from service.config import Settings, load
from service.controller import Controller
from service.figures import Score
from service.logs.blocks import BlockController, received_quaternions
from service.logs.codes import codes_in, encoded, encoded_by, levels

TICKS = 700
ROWS = 64

WIRES = {
    "8/6 bits": [],
    "2 bits": ["wire.attitude.bits=2", "wire.rate.bits=3", "wire.voltage.bits=2"],
    "continuous": ["wire.attitude.bits=cont", "wire.rate.bits=cont", "wire.voltage.bits=cont"],
    "mixed": ["wire.attitude.bits=cont", "wire.rate.bits=16", "wire.rate.deadzone=0.01"],
    "rigid body": ["wire.actuators=3", "plant.kind=rigid_body", "plant.ideal=true"],
}
WIRES["hysteresis"] = [f"wire.{signal}.kind=hysteresis-uniform" for signal in ("attitude", "rate", "voltage")]
WIRES["logarithmic"] = [f"wire.{signal}.kind=logarithmic-uniform" for signal in ("attitude", "rate", "voltage")]
WIRES["continuous rigid body"] = WIRES["continuous"] + WIRES["rigid body"]
REFERENCES: list[Reference | None] = [
    None,
    Hold(attitude=(0.0, 5.0, -10.0)),
    Sinusoid(amplitude=(0.0, 10.0, 30.0), frequency=(0.0, 2.0, 1.0)),
    Points(times=[0.0, 0.1, 0.35], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, 20.0), (0.0, -3.0, 4.0)]),
]


def bits(values: Any) -> list[int]:
    """Doubles as integers: NaN equals itself, and −0 is not 0."""
    found: list[int] = np.asarray(values, dtype=np.float64).ravel().view(np.int64).tolist()
    return found


class Run:
    """Measurements that tumble, ticks that are missing, changes of gains and reference, and sensors that fail."""

    def __init__(self, wire: str, seed: int, *, tumbling: float = 4.0) -> None:
        self.settings: Settings = load(overrides=WIRES[wire])
        self.wire = self.settings.wire
        rng = np.random.default_rng(seed)
        self.k = np.sort(rng.choice(2 * TICKS, TICKS, replace=False))
        turns = np.cumsum(rng.normal(scale=tumbling / 100, size=(TICKS, 4)), axis=0) + rng.normal(size=4)
        q = turns / np.linalg.norm(turns, axis=1, keepdims=True)
        q[q[:, 0] < 0] *= -1  # only ε with η ≥ 0 is sent, so where η changes sign ε jumps
        vectors = np.where(rng.random((TICKS, 1)) < 0.1, 1.05, 1.0) * q[:, 1:]
        rates = rng.normal(size=(TICKS, 3))
        self.codes = np.hstack([encoded(self.wire.attitude, vectors), encoded(self.wire.rate, rates)])
        for i in np.flatnonzero(rng.random(TICKS) < 0.03):
            column = rng.integers(6)
            signal = self.wire.attitude if column < 3 else self.wire.rate
            self.codes[i, column] = signal.quantizer().invalid
        ticks = np.sort(rng.choice(2 * TICKS, 12))
        self.changes = [self._change(int(k), rng) for k in ticks]

    def _change(self, k: int, rng: np.random.Generator) -> Change:
        gains = Gains(
            C1=tuple(rng.uniform(0.1, 0.5, 3)),
            C2=tuple(rng.uniform(0.05, 0.3, 3)),
            Gamma=tuple(rng.uniform(0.01, 0.5, 3)),
        )
        reference = REFERENCES[rng.integers(len(REFERENCES))]
        return Change(
            session="s1",
            tick=k,
            gains=gains if rng.random() < 0.7 else None,
            reference=reference,
            within_s=float(rng.choice([0.0, 0.05, 0.5])),
        )

    def controller(self, kind: type[Controller], **more: int) -> Any:
        s = self.settings
        return kind(s.wire, s.law, s.reference, s.loop.period, **more)

    def one_by_one(self, controller: Controller, first: int = 0) -> Iterator[tuple[list[float], bytes]]:
        """Of each tick all that `Computed` has, NaN where there is none, and the command."""
        changes = deque(change for change in self.changes if first == 0 or change.tick > self.k[first - 1])
        nothing = [float("nan")]
        for k, row in zip(self.k[first:].tolist(), self.codes[first:].tolist(), strict=True):
            while changes and changes[0].tick <= k:
                controller.apply(changes.popleft())
            codes = [row[i] if self.wire.measurement.widths[i] is None else int(row[i]) for i in range(6)]
            theta = controller.damping_estimate
            u = controller.compute(k % 16, codes, k)
            if controller.tick_index == k:
                c = controller
                said = [*c.attitude, *c.desired, *c.rate, *c.attitude_error, *c.rate_error]
                said += nothing * self.wire.actuators if u is None else u
                said += [c.sign, *c._law.inputs["C1"], *theta]
            else:
                said = nothing * (17 + self.wire.actuators + 7)
            sent = controller._no_command if u is None else [e(v) for e, v in zip(controller._encode, u, strict=True)]
            yield said, self.wire.command.pack(k % 16, sent)

    def in_blocks(
        self, controller: BlockController, cuts: Sequence[int], first: int = 0
    ) -> tuple[list[list[float]], list[bytes]]:
        """The same by blocks that end before these ticks."""
        changes = deque(change for change in self.changes if first == 0 or change.tick > self.k[first - 1])
        said, commands = [], []
        edges = [first, *cuts, TICKS]
        for start, end in pairwise(edges):
            block = controller.compute_all(self.k[start:end], self.codes[start:end], changes)
            said += np.hstack(block).tolist()
            for k, row in zip(self.k[start:end], controller.commands(block.voltages).tolist(), strict=True):
                codes = row if self.wire.voltage.bits is None else [int(code) for code in row]
                commands.append(self.wire.command.pack(int(k) % 16, codes))
        return said, commands


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("seed", range(4))
def test_blocks_have_the_bits_of_the_loop_whatever_their_cut(wire: str, seed: int) -> None:
    run = Run(wire, seed)
    single, blocks = run.controller(Controller), run.controller(BlockController, rows=ROWS)
    cuts = np.sort(np.random.default_rng(seed).choice(TICKS, 3 * seed)).tolist()
    ticks = list(run.one_by_one(single))
    said, commands = run.in_blocks(blocks, cuts)
    assert bits(said) == bits([tick for tick, _ in ticks])
    assert commands == [command for _, command in ticks]
    assert (blocks.invalid, blocks.tick_index, blocks.sign) == (single.invalid, single.tick_index, single.sign)
    for name in ("attitude", "desired", "rate", "attitude_error", "rate_error", "damping_estimate"):
        assert bits(getattr(blocks, name)) == bits(getattr(single, name))
    assert blocks.gains == single.gains


@pytest.mark.parametrize("begin", [1, 200])
def test_a_session_taken_up_in_its_middle_goes_on_as_the_loop_would(begin: int) -> None:
    """From telemetry, as a replay does that has only the log's second half; the controller followed −q."""
    run = Run("8/6 bits", 3)
    frame = run.wire.measurement.pack(0, [5, -9, 40, 1, 2, 3])
    single, blocks = run.controller(Controller), run.controller(BlockController, rows=ROWS)
    for controller in (single, blocks):
        controller.resume(frame, int(run.k[begin - 1]), -1, (0.01, 0.02, -0.03), (-0.1, 0.1, -0.5))
    said, commands = run.in_blocks(blocks, [begin + 77], begin)
    ticks = list(run.one_by_one(single, begin))
    assert blocks.sign == -1
    assert bits(said) == bits([tick for tick, _ in ticks])
    assert commands == [command for _, command in ticks]


def test_what_a_hysteresis_holds_is_taken_up_with_the_session() -> None:
    """Whatever was computed meanwhile: what holds is the last valid code that was sent, of each motor."""
    run = Run("hysteresis", 4)
    one, cut = (run.controller(BlockController, rows=ROWS) for _ in range(2))
    volts = np.cumsum(np.random.default_rng(4).normal(scale=0.2, size=(300, 2)), axis=0)
    volts[149] = float("nan")
    whole = one.commands(volts)
    cut.commands(-volts[:40])
    cut.sent(whole[:150])
    assert bits(cut.commands(volts[150:])) == bits(whole[150:])
    fresh = run.controller(BlockController, rows=ROWS).commands(volts[150:])
    assert bits(whole[150:]) != bits(fresh)
    step = 48 / 63
    rise = np.array([[step, -step], [0.3 * step, -0.3 * step]])
    one = run.controller(BlockController, rows=ROWS)
    assert one.commands(rise).tolist() == [[1, -1], [1, -1]]
    one.sent(whole[149:150])  # nothing valid: nothing is held
    assert one.commands(rise[1:]).tolist() == [[0, 0]]


def test_blocks_and_single_ticks_go_on_from_one_another() -> None:
    run = Run("8/6 bits", 5)
    run.changes.clear()
    single, mixed = run.controller(Controller), run.controller(BlockController, rows=ROWS)
    expected = [tick for tick, _ in run.one_by_one(single)]
    said = np.hstack(mixed.compute_all(run.k[:300], run.codes[:300], deque())).tolist()
    for k, codes in zip(run.k[300:310].tolist(), run.codes[300:310].tolist(), strict=True):
        mixed.compute(k % 16, [int(code) for code in codes], k)
    assert bits(said) == bits(expected[:300])
    assert bits(np.hstack(mixed.compute_all(run.k[310:], run.codes[310:], deque()))) == bits(expected[310:])


def test_where_the_law_gives_no_number_no_valid_value_is_commanded() -> None:
    run = Run("continuous rigid body", 6)
    run.codes[100, 3:] = 0.0, 1e200, 1e200  # the first element of ω × Jω is ∞ − ∞, the others are numbers
    single, blocks = run.controller(Controller), run.controller(BlockController, rows=ROWS)
    ticks = list(run.one_by_one(single))
    said, commands = run.in_blocks(blocks, [])
    assert single.failed
    assert blocks.failed
    assert commands == [command for _, command in ticks]
    assert np.isnan([row[-1] for row in said]).tolist() == np.isnan([tick[-1] for tick, _ in ticks]).tolist()


def test_received_quaternions_turn_as_one_received_after_another_does() -> None:
    """Whether the last pointed away, along, or at a right angle, or was longer than 1, or −0."""
    corners = [0.0, -0.0, 0.6, -0.6, 0.8, -0.8, 1.0, -1.0, 1.3, 1e200]
    rng = np.random.default_rng(0)
    for start in (IDENTITY, (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.6, -0.8)):
        vectors = rng.choice(corners, size=(5000, 3), p=[0.25, 0.05, *[0.1] * 6, 0.05, 0.05])
        last: Quaternion = start
        expected = [last := received_quaternion(x, y, z, last) for x, y, z in vectors.tolist()]
        with np.errstate(over="ignore"):
            assert bits(received_quaternions(vectors, start)) == bits(expected)


@pytest.mark.parametrize("bits_and_dead_zone", [(2, None), (6, None), (8, 0.3), (16, None), (None, None)])
def test_codes_and_levels_of_many_are_those_of_each(bits_and_dead_zone: tuple[int | None, float | None]) -> None:
    """On the edges of intervals, too, where the quantizer allows for rounding."""
    width, dead_zone = bits_and_dead_zone
    signal = SignalSpec(bits=width, limit=24.0, deadzone=dead_zone)
    quantizer = signal.quantizer()
    values = [0.0, -0.0, 24.0, -24.0, 24.1, -1e300, float("inf"), *np.random.default_rng(0).normal(scale=15, size=2000)]
    if width is not None:
        step = quantizer.step  # type: ignore[attr-defined]  # a uniform one
        edges = [(dead_zone or step / 2) + i * step for i in range(-40, 40)]
        values += [float(np.nextafter(edge, edge + side)) for edge in edges for side in (-1, 1)] + edges
    codes = [quantizer.encode(value) for value in values]
    assert bits(encoded(signal, np.array(values))) == bits(codes)
    assert bits(encoded(signal, np.array([float("nan")]))) == bits([quantizer.invalid])
    every = [*codes, quantizer.invalid]
    assert bits(levels(signal, np.array(every, dtype=np.float64))) == bits([quantizer.level(code) for code in every])


@pytest.mark.parametrize("kind", ["hysteresis-uniform", "logarithmic-uniform"])
@pytest.mark.parametrize("width", [3, 8, 16])
def test_codes_and_levels_of_many_are_those_of_each_of_any_kind(kind: Kind, width: int) -> None:
    signal = SignalSpec(bits=width, limit=24.0, kind=kind)
    quantizer, twin = signal.quantizer(), signal.quantizer()
    assert isinstance(quantizer, CodedQuantizer)
    values = np.cumsum(np.random.default_rng(width).normal(scale=0.05 * 24, size=2000)) % 60 - 30
    if isinstance(quantizer, LogarithmicQuantizer):
        edges = np.array(quantizer.edges)
        values = np.concatenate([values, edges, -edges, np.nextafter(edges, 0), np.nextafter(edges, 99), [0.0, -0.0]])
    values = np.concatenate([values, [float("inf"), -1e300]])
    codes = [quantizer.encode(value) for value in values.tolist()]
    silent = np.insert(values, 777, float("nan"))  # no valid value leaves what is remembered alone
    expected = [*codes[:777], quantizer.invalid, *codes[777:]]
    assert bits(encoded(signal, silent)) == bits(expected)
    assert encoded(signal, silent).dtype == np.float64
    assert bits([*encoded_by(twin, silent[:900]), *encoded_by(twin, silent[900:])]) == bits(expected)
    assert twin.saturated == 0
    assert bits(levels(signal, np.array(expected))) == bits([quantizer.level(code) for code in expected])


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_a_score_of_many_is_the_score_of_each_to_the_last_bit(cut: int) -> None:
    """Over gaps longer than the watchdog holds a command, and with a command without a valid value."""
    rng = np.random.default_rng(cut)
    k = np.sort(rng.choice(3000, 1000, replace=False))
    k[500:] += 400
    errors, volts = rng.normal(scale=0.1, size=(1000, 3)), rng.normal(size=(1000, 2))
    errors[700] = errors[300] = errors[np.abs(errors).sum(axis=1).argmax()] * 2  # the first of two largest stands
    errors[700] *= -1
    volts[123] = float("nan")
    wire = load().wire
    one, many = Score(wire, 0.002), Score(wire, 0.002)
    for tick, error, voltages in zip(k.tolist(), errors.tolist(), volts.tolist(), strict=True):
        one.error(tick, error)
        one.command(tick, voltages)
    for start in range(0, 1000, cut):
        many.errors(k[start : start + cut], errors[start : start + cut])
        many.commands(k[start : start + cut], volts[start : start + cut])
    assert many.figures() == one.figures()
    assert many._largest == one._largest


@pytest.mark.parametrize("counter_bits", [4, 8, 10])
@pytest.mark.parametrize("widths", [[8] * 6, [6, 6], [10] * 3 + [16] * 3, [2, 3, 5], [None, None], [None, 7, None, 16]])
def test_frames_are_read_many_at_once_as_each(widths: list[int | None], counter_bits: int) -> None:
    kind, rng = FrameFormat(widths, counter_bits), np.random.default_rng(0)
    rows = [
        [
            rng.normal() if width is None else int(rng.integers(-(2 ** (width - 1)), 2 ** (width - 1)))
            for width in widths
        ]
        for _ in range(200)
    ]
    if widths[0] is None:
        rows[7][0], rows[8][0], rows[9][0] = float("nan"), -0.0, 5e-324
    frames = [kind.pack(i % 16, row) for i, row in enumerate(rows)]
    assert bits(codes_in(kind, frames)) == bits(rows)
    assert codes_in(kind, []).shape == (0, len(widths))
    for frame in [*frames, b"", frames[0][:-1], frames[0] + b"\0", *(bytes([*frames[0][:-1], i]) for i in range(256))]:
        read = kind.unpack(frame)
        assert kind.counter(frame) == (None if read is None else read[0])
