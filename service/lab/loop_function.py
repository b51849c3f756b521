"""The closed loop in lockstep as one function: measurement, law, command and plant of a tick, mapped over the ticks.

It contains the functions of law, plant and sensors as the two ends evaluate them, and the quantizers as expressions,
all `as_written`: so every bit is that of the loop through frames. Bits, limits, gains, and zeros of the encoders are
part of its state; reference, wind and a gyro's errors are computed beforehand. One function serves all that differ in
these, such as every candidate of a search for gains.

A run near a limit of the guard, or with a value that is no number, is abnormal: it is to be run through frames, which
gives its exact reason.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import lru_cache
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from aeroloop.plant_emulator.endpoint.limits import LimitSettings
from aeroloop.plant_emulator.model.emulated import (
    Sensors,
    WindSettings,
    initially,
    sensor_function,
    step_function,
    wind_torques,
)
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.expressions import NUMBERS, as_written, encode, level, numbers, with_numbers
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.interface import ExpressionLaw, Law
from aeroloop.service.control.laws.registry import configured_gains, initial_state, law_class, law_function, law_of
from aeroloop.service.control.reference import Floats, desired

BLOCK: Final = 512
"""Ticks of one call."""
COMPILED_FROM: Final = 30_000
"""Ticks of all runs from which on a function is compiled to C, which takes as long as some 40 000 ticks without."""
_LOOPS: Final = 8
_NEAR: Final = 1e-9
"""A value this close to a limit, as a part of it, is left to the frames: sums and roots round differently."""


class Course(NamedTuple):
    """What a loop did at each tick.

    Attributes:
        measured: Codes of the measurements. Shape (ticks, 6).
        commanded: Codes of the commands. Shape (ticks, actuators).
        voltages: Their levels [V]. Shape (ticks, actuators).
        errors: ε̃ [1]. Shape (ticks, 3).
    """

    measured: Floats
    commanded: Floats
    voltages: Floats
    errors: Floats


class Loop:
    """The closed loop of a configuration, and of all that differ from it in the function's inputs.

    Attributes:
        tick: One tick. Inputs: state; desired (q_d, ω_d, ω̇_d), wind [N·m], error of the gyro [rad/s]. Outputs: after,
            the next state; out, what was measured, commanded and seen.
        in_c: Whether it runs as compiled C.
    """

    def __init__(self, settings: Settings) -> None:
        wire, period, plant = settings.wire, settings.loop.period, settings.plant
        law = _evaluated(settings)
        self._mechanism = mechanism = plant.mechanism()
        self._initially = initially(mechanism)
        step = step_function(mechanism, plant.rotor, plant.friction, period)
        sizes = {
            "x": step.numel_in("x"), "last": 4, "law": len(law.state), "seen": 7, "filters": 4, "measured": 6,
            "commanded": wire.actuators, "numbers": 3 * len(NUMBERS), "zeros": 2, "gains": len(law.gains),
        }  # fmt: skip
        self._still = [0.0] * (sizes["x"] - len(mechanism.initial))
        functions = law.function, step, sensor_function(plant.sensors, period)
        with as_written():
            self.tick = self._tick(settings, sizes, functions)
        self.in_c = self._tried_c = False
        self._ticks = 0
        self._desired: tuple[object, Floats] = None, np.empty(0)
        self._map(self.tick)

    def _tick(
        self, settings: Settings, sizes: dict[str, int], functions: tuple[ca.Function, ca.Function, ca.Function]
    ) -> ca.Function:
        law, step, sensors = functions
        wire, limit = settings.wire, settings.plant.voltage_limit
        state = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        wanted, wind, error = ca.SX.sym("desired", 10), ca.SX.sym("wind", step.numel_in("wind")), ca.SX.sym("error", 3)
        signals: list[SignalSpec] = [wire.attitude, wire.rate, wire.voltage]
        attitude, rate, voltage = (
            with_numbers(signal.quantizer(), part)
            for signal, part in zip(signals, ca.vertsplit(state["numbers"], len(NUMBERS)), strict=True)
        )

        seen = state["seen"]
        sent = ca.vertcat(ca.if_else(seen[0] >= 0, 1, -1) * seen[1:4], seen[4:7])
        kinds = [attitude] * 3 + [rate] * 3
        measured = [encode(kinds[i], sent[i], state["measured"][i]) for i in range(6)]
        levels = ca.vertcat(*(level(kinds[i], measured[i]) for i in range(6)))

        parts = ca.vertsplit(wanted, [0, 4, 7, 10])
        answers = law.call([state["last"], state["law"], state["gains"], levels[:3], levels[3:], *parts])
        answer = dict(zip(law.name_out(), answers, strict=True))
        u = answer["u"]
        commanded = [encode(voltage, u[i], state["commanded"][i]) for i in range(wire.actuators)]
        voltages = ca.vertcat(*(level(voltage, code) for code in commanded))

        x, *true = step.call([state["x"], ca.fmax(-limit, ca.fmin(limit, voltages)), wind])
        if not true[2].numel():
            true[2] = ca.SX.zeros(2)  # a free body has no joints, and so no encoders
        next_seen, filters = sensors.call([*true, state["filters"], state["zeros"], error])
        codes = {"measured": ca.vertcat(*measured), "commanded": ca.vertcat(*commanded)}
        learned = {"last": answer["q"], "law": answer["state_next"]}
        after = {**state, **codes, **learned, "x": x, "seen": next_seen, "filters": filters}
        out = {**codes, "voltages": voltages, "errors": answer["eps_e"], "u": u, "seen": seen}
        self._outputs = {name: part.numel() for name, part in out.items()}
        return ca.Function(
            "tick",
            [ca.vertcat(*state.values()), wanted, wind, error],
            [ca.densify(ca.vertcat(*parts.values())) for parts in (after, out)],
            ["state", "desired", "wind", "error"],
            ["after", "out"],
            {"cse": True},
        )

    def _map(self, tick: ca.Function) -> None:
        self._block = Compiled(tick.mapaccum("loop", BLOCK))
        inputs, outputs = self._block.inputs, self._block.outputs
        self._state = np.asarray(inputs["state"])
        self._rows = {name: np.asarray(inputs[name]).reshape(BLOCK, -1) for name in ("desired", "wind", "error")}
        self._after, self._out = (np.asarray(outputs[name]).reshape(BLOCK, -1) for name in ("after", "out"))

    def run(self, settings: Settings, ticks: int, report: Callable[[int], None] = lambda _: None) -> Course | None:
        """Run so many ticks, at least one; None if anything is abnormal. `report` is called with the ticks done."""
        self._ticks += ticks
        if self._ticks >= COMPILED_FROM and not self._tried_c:
            self._tried_c = True
            if (compiled := in_c(self.tick)) is not None:
                self.in_c = True
                self._map(compiled)
        given = self.inputs(settings, ticks)
        self._state[:] = given.pop("state")
        out = np.empty((ticks, sum(self._outputs.values())))
        for start in range(0, ticks, BLOCK):
            rows = min(BLOCK, ticks - start)  # of the last block the rest is computed in vain
            for name, column in given.items():
                self._rows[name][:rows] = column[start : start + rows]
            self._block()
            self._state[:] = self._after[-1]
            out[start : start + rows] = self._out[:rows]
            report(start + rows)
        ends = np.cumsum(list(self._outputs.values()))
        parts = dict(zip(self._outputs, np.split(out, ends[:-1], axis=1), strict=True))
        u, seen = parts.pop("u"), parts.pop("seen")
        course = Course(**parts)
        return course if _normal(settings, course.voltages, u, seen) else None

    def inputs(self, settings: Settings, ticks: int) -> dict[str, Floats]:
        """Inputs of every tick, by name, a row each; the state at the first. Random numbers as the plant draws them."""
        plant, wire, period = settings.plant, settings.wire, settings.loop.period
        wind, sensors = wind_torques(plant.wind, self._mechanism.axes, period), Sensors(plant.sensors, period)
        seen = sensors.read(*self._initially)
        held = [np.nan] * (6 + wire.actuators)
        quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate, wire.voltage)]
        x = *self._mechanism.initial, *self._still
        law = _evaluated(settings)
        first = [*x, *IDENTITY, *law.state, *seen.attitude, *seen.rate, *sensors.held, *held]
        state = np.array([*first, *(number for q in quantizers for number in numbers(q)), *sensors.zeros, *law.gains])
        torque, error = np.zeros((ticks, self._mechanism.axes)), np.zeros((ticks, 3))
        if wind is not None:
            torque[:] = [next(wind) for _ in range(ticks)]
        if plant.sensors.rate == "gyro":
            error[:] = [next(sensors.errors) for _ in range(ticks)]
        if self._desired[0] != (key := (settings.reference, ticks)):  # the cells of a table share it
            self._desired = key, np.ascontiguousarray(desired(settings.reference, period, ticks))
        return {"state": state, "desired": self._desired[1], "wind": torque, "error": error}


def _normal(settings: Settings, voltages: Floats, u: Floats, seen: Floats) -> bool:
    """Whether every value is finite, and none so near to a limit that the plant might trip."""
    limits = settings.plant.limits
    if not (np.abs(u).max() < 1e100 and np.abs(seen).max() < 1e100):
        return False
    cosine = np.cos(np.radians(limits.max_tilt_deg))
    upright = 1 - 2 * (seen[:, 1] ** 2 + seen[:, 2] ** 2)
    speed = np.sqrt((seen[:, 4:] ** 2).sum(axis=1))
    if upright.min() < cosine + _NEAR or speed.max() > limits.max_rate * (1 - _NEAR):
        return False
    full = min(settings.plant.voltage_limit, settings.wire.voltage.quantizer().outermost)
    saturated = np.concatenate([[False], np.abs(voltages).max(axis=1) >= full, [False]])
    ends = np.flatnonzero(np.diff(saturated))
    longest = (ends[1::2] - ends[::2]).max(initial=0) * settings.loop.period
    return bool(longest < limits.max_saturated_s * (1 - _NEAR))


class _Evaluated(NamedTuple):
    """A law as a function, the function as text, its configured gains and its state before the first tick."""

    function: ca.Function
    text: str
    gains: list[float]
    state: list[float]


def _evaluated(settings: Settings) -> _Evaluated:
    return _law(law_class(settings.law), settings.law.model_dump_json(), settings.loop.period, settings.wire.actuators)


@lru_cache(maxsize=16)
def _law(kind: type[Law[Any]], section: str, period: float, actuators: int) -> _Evaluated:
    law = law_of(kind.Settings.model_validate_json(section), period, actuators)
    assert isinstance(law, ExpressionLaw)  # `experiment` runs others through frames
    function = law_function(law)
    gains, state = configured_gains(law).values(), initial_state(law).values()
    return _Evaluated(function, function.serialize(), list(chain(*gains)), list(chain(*state)))


_loops: dict[str, Loop] = {}


def loop_of(settings: Settings) -> Loop:
    """The loop of a configuration; the last few are kept. Laws that are the same but for their gains share one."""
    plant, wire = settings.plant, settings.wire
    sensors = plant.sensors.model_copy(update={"seed": 0, "gyro_noise": 0.0, "gyro_bias": (0.0, 0.0, 0.0)})
    alike = plant.model_copy(update={"wind": WindSettings(), "sensors": sensors, "limits": LimitSettings()})
    kinds = [(signal.bits is None, signal.kind) for signal in (wire.attitude, wire.rate, wire.voltage)]
    key = f"{alike.model_dump_json()}{_evaluated(settings).text}{settings.loop.period_ns}{wire.actuators}{kinds}"
    if key not in _loops:
        while len(_loops) >= _LOOPS:
            del _loops[next(iter(_loops))]
        _loops[key] = Loop(settings)
    return _loops[key]


def in_c(function: ca.Function) -> ca.Function | None:
    """The same function in C, compiled by CasADi's importer and several times as fast as its virtual machine.

    `-ffp-contract=off` keeps every rounding, so the bits are the same. None where there is no compiler, or it fails.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    try:
        with TemporaryDirectory(prefix="aeroloop-") as folder:  # what is loaded stays, without its file
            source = Path(folder, generator.generate(f"{folder}/"))
            options: dict[str, Any] = {
                "compiler": compiler, "linker": compiler, "compiler_flags": ("-O1", "-ffp-contract=off"),
                "directory": f"{folder}/", "cleanup": False,  # the folder goes as a whole
            }  # fmt: skip
            return ca.external(function.name(), ca.Importer(str(source), "shell", options))
    except (OSError, RuntimeError):  # no place for files, or no library came of it
        return None
