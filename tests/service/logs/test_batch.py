"""Batch evaluation of ticks: bit for bit equal to tick-by-tick evaluation, for any split and any start."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.protocol.messages.operator import Change, Gains, Hold, Points, Reference, Sinusoid, Stream
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.logarithmic import LogarithmicQuantizer
from aeroloop.protocol.wire.quantizer import CodedQuantizer, Quantizer
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.protocol.wire.transmit import SILENCE
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.logs.batch import BatchController, Commands, Computed
from aeroloop.service.logs.codes import codes_in, encoded_by, frames_of, levels

TICKS = 300
ROWS = 64

CONTINUOUS = [f"wire.{signal}.bits=cont" for signal in ("attitude", "rate", "voltage")]
RIGID = ["wire.actuators=3", "plant.kind=rigid_body", "plant.ideal=true"]
ON_CHANGE = ["wire.transmit.command=on_change"]
WIRES = {
    "8/6 bits": [],
    "2 bits": ["wire.attitude.bits=2", "wire.rate.bits=3", "wire.voltage.bits=2", *ON_CHANGE],
    "continuous": CONTINUOUS,
    "mixed": ["wire.attitude.bits=cont", "wire.rate.bits=16", "wire.rate.deadzone=0.01", *ON_CHANGE],
    "rigid body": RIGID,
    "continuous rigid body": [*CONTINUOUS, *RIGID, *ON_CHANGE],
    "logarithmic": [f"wire.{signal}.kind=logarithmic-uniform" for signal in ("attitude", "rate", "voltage")],
    "hysteresis": [f"wire.{signal}.kind=hysteresis-uniform" for signal in ("attitude", "rate", "voltage")],
    "coarse hysteresis": ["wire.voltage.kind=hysteresis-uniform", "wire.voltage.limit=999", *RIGID, *ON_CHANGE],
}
REFERENCES: list[Reference | None] = [
    None,
    Hold(attitude=(0.0, 5.0, -10.0)),
    Sinusoid(amplitude=(0.0, 10.0, 30.0), frequency=(0.0, 2.0, 1.0)),
    Points(times=[0.0, 0.1, 0.35], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, 20.0), (0.0, -3.0, 4.0)]),
    Stream(),  # rests at 0
]


def bits(values: Any) -> list[int]:
    """Doubles as integers: NaN equals itself, and −0 is not 0."""
    found: list[int] = np.asarray(values, dtype=np.float64).ravel().view(np.int64).tolist()
    return found


def encoded(signal: SignalSpec, values: Any) -> Any:
    """The code of each value, by one quantizer."""
    encode = signal.quantizer().encode
    return np.vectorize(encode, otypes=[np.float64])(values)


class Run:
    """Measurements that tumble, ticks that are missing, changes of gains and reference, and sensors that fail."""

    def __init__(self, wire: str, seed: int, *overrides: str) -> None:
        self.settings: Settings = load(overrides=[*WIRES[wire], *overrides])
        self.wire = self.settings.wire
        rng = np.random.default_rng(seed)
        self.k = np.sort(rng.choice(2 * TICKS, TICKS, replace=False))
        turns = np.cumsum(rng.normal(scale=rng.choice([1e-4, 0.04]), size=(TICKS, 4)), axis=0) + rng.normal(size=4)
        q = turns / np.linalg.norm(turns, axis=1, keepdims=True)
        q[q[:, 0] < 0] *= -1  # only ε with η ≥ 0 is sent, so where η changes sign ε jumps
        vectors = np.where(rng.random((TICKS, 1)) < 0.1, 1.05, 1.0) * q[:, 1:]
        rates = rng.choice([0.01, 1.0]) * rng.normal(size=(TICKS, 3))
        corners = rng.random(TICKS) < rng.choice([0.0, 0.5])  # where every sum may be 0 or −0
        vectors[corners] = rng.choice([0.0, -0.0, 0.6, -0.8, 1.0], size=(TICKS, 3))[corners]
        rates[corners] = rng.choice([0.0, -0.0, 0.5], size=(TICKS, 3))[corners]
        self.codes = np.hstack([encoded(self.wire.attitude, vectors), encoded(self.wire.rate, rates)])
        for i in np.flatnonzero(rng.random(TICKS) < 0.03):
            column = rng.integers(6)
            signal = self.wire.attitude if column < 3 else self.wire.rate
            self.codes[i, column] = signal.quantizer().invalid
        self.changes = [self._change(int(k), rng) for k in np.sort(rng.choice(2 * TICKS, 8))]

    def gains(self, rng: np.random.Generator) -> Gains:
        """Other gains of the law."""
        return Gains(
            C1=tuple(rng.uniform(0.1, 0.5, 3)),
            C2=tuple(rng.uniform(0.05, 0.3, 3)) if rng.random() < 0.5 else None,
            Gamma=tuple(rng.uniform(0.01, 0.5, 3)),
        )

    def _change(self, k: int, rng: np.random.Generator) -> Change:
        gains = self.gains(rng)
        brakes = rng.random() < 0.4
        return Change(
            session="s1",
            tick=k,
            gains=gains if rng.random() < 0.7 else None,
            reference=REFERENCES[rng.integers(len(REFERENCES))],
            within_s=0.5 if brakes else float(rng.choice([0.0, 0.05, 0.5])),
            brake_s=(0.0, 0.123, 0.2) if brakes else None,
            run_up_s=(0.0, 0.2, 0.017) if brakes else None,
            start=(0.0, 3.0, -7.0) if rng.random() < 0.2 else None,
        )

    def controller(self, kind: type[Any], state: ControllerSnapshot | None, **more: int) -> Any:
        """A controller as at the start, or one restored from a state that has been through JSON."""
        s = self.settings
        controller = kind(s.wire, s.law, s.reference, s.loop.period, **more)
        if state is not None:
            controller.restore(ControllerSnapshot.model_validate_json(state.model_dump_json()))
        return controller

    def loop(self, state: ControllerSnapshot | None = None, first: int = 0) -> tuple[list[Any], list[Any], list[Any]]:
        """Of each tick the state before it, all that `Computed` has, NaN where there is none, and the frame sent."""
        controller, changes = self.controller(Controller, state), deque(self.changes)
        states, computed, sent = [], [], []
        for k, row in zip(self.k[first:].tolist(), self.codes[first:].tolist(), strict=True):
            while changes and changes[0].tick <= k:
                controller.apply(changes.popleft())
            codes = [row[i] if self.wire.measurement.widths[i] is None else int(row[i]) for i in range(6)]
            states.append(before := controller.state)
            sent.append(controller.tick(self.wire.measurement.pack(k % 16, codes), k))
            c, parts = controller, (controller.gains.named, before.law, controller.law_state)
            of_law = [value for named in parts for values in named.values() for value in values]
            said = [float("nan")] * (17 + self.wire.actuators + len(of_law))
            if c.tick_index == k:
                u = [float("nan")] * self.wire.actuators if c.fault else c.voltages
                said = [*c.attitude, *c.desired, *c.rate, *c.attitude_error, *c.rate_error, *u, *of_law]
            computed.append(said)
        return [*states, controller.state], computed, sent

    def batch(
        self, cuts: Sequence[int], states: Sequence[ControllerSnapshot | None]
    ) -> tuple[list[ControllerSnapshot], Any, list[bytes]]:
        """The same by blocks that end before these rows: by the same controller, or one restored where a state is."""
        controller, changes = self.controller(BatchController, None, rows=ROWS), deque(self.changes)
        after, computed, sent = [], [], []
        for (start, end), state in zip(pairwise([0, *cuts, TICKS]), [None, *states], strict=True):
            if state is not None:
                controller, changes = self.controller(BatchController, state, rows=ROWS), deque(self.changes)
            block: Computed = controller.compute_all(self.k[start:end], self.codes[start:end], changes)
            commands: Commands = controller.commands(self.k[start:end], block.voltages)
            computed.append(np.hstack(block))
            for k, row, due in zip(self.k[start:end].tolist(), commands.codes.tolist(), commands.sent, strict=True):
                codes = row if self.wire.voltage.bits is None else [int(code) for code in row]
                sent.append(self.wire.command.pack(k % 16, codes) if due else SILENCE)
            after.append(controller.state)
        return after, np.vstack(computed), sent

    def check(self, cuts: Sequence[int], restored: Sequence[bool]) -> None:
        """Blocks that end before these rows have the bits of the loop; some are begun from its state."""
        states, computed, sent = self.loop()
        begun = [states[cut] if anew else None for cut, anew in zip(cuts, restored, strict=False)]
        after, columns, commands = self.batch(cuts, begun)
        assert bits(columns) == bits(computed)
        assert commands == sent
        assert [state.model_dump_json() for state in after] == [states[cut].model_dump_json() for cut in [*cuts, TICKS]]
        for cut in cuts:
            _, again, resent = self.loop(states[cut], cut)
            assert (bits(again), resent) == (bits(computed[cut:]), sent[cut:])


@settings(max_examples=8)
@given(
    wire=st.sampled_from(sorted(WIRES)),
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, TICKS), max_size=3).map(sorted),
    restored=st.lists(st.booleans(), min_size=3, max_size=3),
)
def test_blocks_have_the_bits_of_the_loop_whatever_their_cut(
    wire: str, seed: int, cuts: list[int], restored: list[bool]
) -> None:
    """And so has what goes on from the loop's recorded state, in a loop or in blocks."""
    Run(wire, seed).check(cuts, restored)


def test_what_a_hysteresis_holds_goes_with_the_state() -> None:
    run = Run("coarse hysteresis", 4)
    run.changes.clear()
    run.codes = np.rint(np.cumsum(np.random.default_rng(4).normal(size=(TICKS, 6)), axis=0))  # slowly, by code
    states, _, sent = run.loop()
    cuts, differing = range(10, TICKS, 20), 0
    for cut in cuts:
        assert run.loop(states[cut], cut)[2] == sent[cut:]
        assert run.batch([cut], [states[cut]])[2] == sent
        differing += run.loop(states[cut].model_copy(update={"voltage_codes": None}), cut)[2] != sent[cut:]
    assert differing > len(cuts) / 4  # so it mattered


def test_where_the_law_gives_no_number_no_valid_value_is_commanded() -> None:
    run = Run("continuous rigid body", 6)
    run.codes[100, 3:] = 0.0, 1e200, 1e200  # the first element of ω × Jω is ∞ − ∞, the others are numbers
    states, computed, sent = run.loop()
    _, columns, commands = run.batch([], [])
    assert np.isnan(columns[100:, 17:20]).all()
    np.testing.assert_array_equal(columns, computed)
    assert commands == sent
    assert sent[150:].count(SILENCE) > 100
    assert run.loop(states[150], 150)[2] == sent[150:]  # NaN goes through JSON, too, and is no change of levels


@st.composite
def signals(draw: st.DrawFn) -> SignalSpec:
    """Of every kind, with every number of bits."""
    bits, kind = draw(st.none() | st.integers(2, 16)), draw(st.sampled_from(["uniform", "hysteresis", "logarithmic"]))
    fraction = draw(st.none() | st.floats(0.001, 0.2))
    try:
        return SignalSpec(
            bits=bits,
            limit=24.0,
            kind="uniform" if kind == "uniform" or bits is None else f"{kind}-uniform",  # type: ignore[arg-type]
            deadzone=None if fraction is None else fraction * 24.0,
        )
    except (ValidationError, ValueError):
        assume(False)
        raise


def _edges(quantizer: Quantizer) -> Any:
    """Where codes change."""
    if isinstance(quantizer, LogarithmicQuantizer):
        return np.array(quantizer.edges)
    if isinstance(quantizer, CodedQuantizer):
        return quantizer.deadzone + np.arange(min(quantizer.top + 1, 300)) * quantizer.step  # type: ignore[attr-defined]  # a uniform one
    return np.zeros(0)


@given(signal=signals(), seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 1000))
def test_codes_and_levels_of_many_are_those_of_each(signal: SignalSpec, seed: int, cut: int) -> None:
    """On the edges of intervals, too, where the quantizer allows for rounding, and after values that are none."""
    rng, quantizer, twin = np.random.default_rng(seed), signal.quantizer(), signal.quantizer()
    edges = rng.permutation(_edges(quantizer))[:300]
    near = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 99)])
    walk = np.cumsum(rng.normal(scale=1.2, size=700)) % 60 - 30
    ends = [0.0, -0.0, 24.0, -24.0, 24.1, 1e300, -1e300, float("inf"), float("-inf"), float("nan")]
    values = rng.permutation(np.concatenate([walk, near, -near, ends]))
    values = np.concatenate([walk, values])
    codes = [quantizer.encode(y) if y == y else quantizer.invalid for y in values.tolist()]
    assert bits([*encoded_by(twin, values[:cut]), *encoded_by(twin, values[cut:])]) == bits(codes)
    assert twin.saturated == 0
    assert bits(levels(signal, np.array(codes, dtype=np.float64))) == bits([quantizer.level(code) for code in codes])


@given(
    widths=st.lists(st.none() | st.integers(2, 16), min_size=1, max_size=7),
    counter_bits=st.integers(4, 16),
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 40),
)
def test_frames_are_read_and_written_many_at_once_as_each(
    widths: list[int | None], counter_bits: int, seed: int, n: int
) -> None:
    """Given as bytes, as an array of frames, and as a strided array of octets."""
    kind, rng = FrameFormat(widths, counter_bits), np.random.default_rng(seed)
    floats = [float("nan"), -0.0, 5e-324, -1.7e308, *rng.normal(size=10)]
    rows = [
        [
            float(rng.choice(floats)) if width is None else int(rng.integers(-(2 ** (width - 1)), 2 ** (width - 1)))
            for width in widths
        ]
        for _ in range(n)
    ]
    counters = rng.integers(kind.counters, size=n)
    frames = [kind.pack(int(counter), row) for counter, row in zip(counters, rows, strict=True)]
    table = np.zeros(n, dtype=[("tick", "<u4"), ("frame", f"V{kind.size}")])
    table["frame"] = np.array(frames, dtype=f"V{kind.size}")
    octets = table.view(np.uint8).reshape(n, 4 + kind.size)[:, 4:]
    for given_as in (frames, table["frame"], octets):
        codes = codes_in(kind, given_as)
        assert codes.shape == (n, len(widths))
        assert bits(codes) == bits(rows)
    values = np.array(rows, dtype=np.float64).reshape(n, len(widths))
    assert [row.tobytes() for row in frames_of(kind, counters, values)] == frames
