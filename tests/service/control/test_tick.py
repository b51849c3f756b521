"""A tick as one function: to the last bit what its parts give one after the other, in memory that stays.

`Composed` below is the composition: unpack, decode, reference, law, encode, pack, each by the part itself.
"""

from __future__ import annotations

from math import isnan
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Hold, Points, Reference, Sinusoid
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.adaptive import Adaptive, AdaptiveSettings
from aeroloop.service.control.laws.evaluation import law_function
from aeroloop.service.control.motion import Motion

PERIOD = 0.002
LAW = AdaptiveSettings(Gamma=(0.5, 0.5, 0.5), damping_estimate=(0.0, 0.03, 0.039))
"""Its θ̂ reaches the projection."""

REFERENCES: tuple[Reference, ...] = (
    Sinusoid(),
    Hold(attitude=(0.0, 5.0, 170.0)),
    Points(times=[0.0, 0.1, 0.35], attitudes=[(0.0, 0.0, 0.0), (5.0, 5.0, 20.0), (0.0, -3.0, 4.0)]),
)


class Composed:
    """The controller's parts, one after the other."""

    def __init__(self, wire: WireSpec, reference: Reference) -> None:
        self.wire = wire
        self.law = Compiled(law_function(Adaptive(LAW, PERIOD, wire.actuators)))
        given = self.law.inputs
        self.motion = Motion(reference, {name: given[name] for name in ("q_d", "omega_d", "omega_d_dot")})
        self.decoders = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
        self.encoders = [wire.voltage.quantizer() for _ in range(wire.actuators)]
        given["last"][0] = 1.0
        for name, values in (("state", LAW.damping_estimate), ("gains", (*LAW.C1, *LAW.C2, *LAW.Gamma))):
            for i, value in enumerate(values):
                given[name][i] = value
        self.refused = self.invalid = 0
        self.failed = False
        self.voltages: list[float] = [0.0] * wire.actuators

    def tick(self, frame: bytes, k: int) -> bytes | None:
        read = self.wire.measurement.unpack(frame)
        if read is None:
            self.refused += 1
            return None
        no_command = self.wire.command.pack(read[0], [quantizer.invalid for quantizer in self.encoders])
        levels = [quantizer.level(code) for quantizer, code in zip(self.decoders, read[1], strict=True)]
        if any(map(isnan, levels)):
            self.invalid += 1
            return no_command
        given, found = self.law.inputs, self.law.outputs
        for i in range(3):
            given["eps"][i], given["omega"][i] = levels[i], levels[3 + i]
        self.motion.at(k * PERIOD)
        if not given["state"][3]:
            given["state"][3] = 1.0
            self.law()
            given["state"][3] = 1.0 if found["eta_e"][0] >= 0 else -1.0
        self.law()
        given["last"][:], given["state"][:] = found["q"], found["state_next"]
        voltages = list(found["u"])
        if isnan(sum(voltages)):
            self.failed = True
            return no_command
        self.voltages = voltages
        codes = [quantizer.encode(u) for quantizer, u in zip(self.encoders, voltages, strict=True)]
        return self.wire.command.pack(read[0], codes)

    def seen(self) -> str:
        """All that a controller reports, as text: it keeps every bit, and NaN equals itself."""
        given, found = self.law.inputs, self.law.outputs
        vectors = given["last"], given["omega"], given["q_d"], given["state"], found["eps_e"], found["omega_e"]
        counts = self.refused, self.invalid, self.failed, sum(q.saturated for q in self.encoders)
        return repr(([vector.tolist() for vector in vectors], self.voltages, counts))


def seen(controller: Controller) -> str:
    """The same of a controller."""
    c = controller
    state = [value for values in c.law_state.values() for value in values]
    vectors = c.attitude, c.rate, c.desired, state, c.attitude_error, c.rate_error
    counts = c.refused, c.invalid, c.fault is not None, c.saturated
    return repr(([list(vector) for vector in vectors], list(c.voltages), counts))


@st.composite
def signals(draw: st.DrawFn, limit: float) -> SignalSpec:
    """Every kind with few and many bits, and none."""
    kind = draw(st.sampled_from(["uniform", "hysteresis-uniform", "logarithmic-uniform"]))
    bits = draw(st.integers(3, 16) if kind != "uniform" else st.none() | st.integers(2, 16))
    deadzone = draw(st.sampled_from([None, 0.01])) if kind == "uniform" else None
    return SignalSpec.model_validate({"kind": kind, "bits": bits, "limit": limit, "deadzone": deadzone})


wires = st.builds(
    WireSpec,
    attitude=signals(1.0),
    rate=signals(1.0),
    voltage=st.sampled_from([24.0, 1000.0]).flatmap(signals),
    actuators=st.sampled_from([2, 3]),
    counter_bits=st.sampled_from([4, 8, 11]),
)


def frames(wire: WireSpec, random: Random, count: int) -> list[bytes]:
    """Measurements that wander by small steps of each value; some are extreme, some have no valid value or are bad."""
    kind = wire.measurement
    quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
    values = [random.uniform(-0.6, 0.6) for _ in quantizers]
    made = []
    for k in range(count):
        values = [max(-1.0, min(1.0, value + random.gauss(0.0, 0.03))) for value in values]
        extreme = random.random() < 0.1
        exact = [random.choice([0.0, -0.0, 1.0, -1.0]) if extreme else value for value in values]
        codes = [quantizer.encode(value) for quantizer, value in zip(quantizers, exact, strict=True)]
        if random.random() < 0.05:
            failed = random.randrange(6)
            codes[failed] = quantizers[failed].invalid
        if wire.rate.bits is None and random.random() < 0.02:
            codes[3:] = 0.0, 1e200, 1e200  # ∞ − ∞ in ω × Jω
        frame = kind.pack(k % kind.counters, codes)
        made.append(frame[:-1] if random.random() < 0.03 else frame)
    return made


@settings(max_examples=25)
@given(wire=wires, reference=st.sampled_from(REFERENCES), seed=st.integers(0, 2**32 - 1))
def test_a_tick_has_the_bits_of_its_parts_one_after_the_other(wire: WireSpec, reference: Reference, seed: int) -> None:
    """Also after its state has been through JSON, at any tick."""
    random = Random(seed)
    composed, controller = Composed(wire, reference), Controller(wire, LAW, reference, PERIOD)
    k = random.choice([0, 3])
    for frame in frames(wire, random, 60):
        assert controller.tick(frame, k) == composed.tick(frame, k)
        assert seen(controller) == composed.seen()
        if random.random() < 0.1:
            controller.restore(ControllerSnapshot.model_validate_json(controller.state.model_dump_json()))
        k += random.choice([1, 1, 1, 40])
