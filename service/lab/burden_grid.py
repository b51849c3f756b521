"""Grid of `lab burden`: its cells and the configuration of each.

Bits range from those at which the loop begins to shake to those beyond which more gain nothing. Sensors range from
perfect ones to a gyro with noise wider than a step: noise, more than motion, changes a level from one tick to the
next. So besides one kind of quantizer for all signals, one choice has hysteresis on the noisy signal alone, the rate.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import product
from typing import Any, Final, NamedTuple, get_args

from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import Kind, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Transmit
from aeroloop.protocol.wording import problem
from aeroloop.service.config import Settings

_Bits = tuple[int | None, int | None]  # out and in; None is float64

BITS: Final = ("6/4", "7/5", "8/6", "9/7", "10/8", "12/10")
FLOAT64: Final = (None, None)
QUANTIZERS: Final[dict[str, tuple[Kind, Kind, Kind]]] = {
    **{kind: (kind, kind, kind) for kind in get_args(Kind)},
    "hysteresis-rate": ("uniform", "hysteresis-uniform", "uniform"),
}
"""Kinds for ε, ω and u, by the name of the choice."""


class BurdenError(AeroloopError):
    """The grid cannot be run; one line with the reason."""


class SensorChoice(NamedTuple):
    """A choice of sensors: a description for a person, and fields of `plant.sensors`."""

    text: str
    changes: dict[str, Any]


SENSORS: Final = {
    "perfect": SensorChoice(
        "the true attitude and rate, so that only quantizers come between the body and the law",
        {"attitude": "perfect", "rate": "perfect"},
    ),
    "encoders": SensorChoice(
        "encoders and their filtered derivative, as on the paper's bench",
        {"attitude": "encoders", "rate": "derivative"},
    ),
    "gyro": SensorChoice(
        "encoders and a gyro with 2 mrad/s of noise, as MEMS gyros have at rest; a quarter of the 8-bit step",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.002},
    ),
    "shaken-gyro": SensorChoice(
        "encoders and a gyro with 20 mrad/s of noise, as of one that the rotors shake; 2.5 steps of 8 bits",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.02},
    ),
}
"""Other fields of `plant.sensors` stay as configured."""


class BurdenCell(NamedTuple):
    """One experiment. Bits of None are float64; the quantizer is None where nothing is quantized."""

    bits_out: int | None
    bits_in: int | None
    quantizer: str | None
    sensors: str


def grid(
    settings: Settings, bits: Sequence[str] = (), quantizers: Sequence[str] = (), sensors: Sequence[str] = ()
) -> list[BurdenCell]:
    """The cells of a grid, always with float64. An empty argument selects all.

    Args:
        settings: The configuration.
        bits: Bits out and in, such as 8/6; `cont` for float64.
        quantizers: Names out of QUANTIZERS.
        sensors: Names out of SENSORS.

    Raises:
        BurdenError: An unknown name, or a cell that the configuration does not allow.
    """
    if settings.plant.ideal:
        raise BurdenError("plant.ideal has no sensors to choose: leave it out and give --sensors perfect")
    pairs = [pair for pair in dict.fromkeys(_pair(text) for text in bits or BITS) if pair != FLOAT64]
    kinds = _chosen("--quantizer", quantizers, QUANTIZERS)
    levels = _chosen("--sensors", sensors, SENSORS)
    choices: list[tuple[_Bits, str | None]] = [*product(pairs, kinds), (FLOAT64, None)]
    cells = [BurdenCell(*pair, kind, level) for level in levels for pair, kind in choices]
    for cell in cells:
        cell_settings(settings, cell)
    return cells


def cell_settings(settings: Settings, cell: BurdenCell) -> Settings:
    """The configuration of a cell, sending at every tick.

    Raises:
        BurdenError: The bits are too few for the quantizer, or the plant has no such sensors.
    """
    wire, plant = settings.wire, settings.plant
    out, inp = cell.bits_out, cell.bits_in
    attitude, rate, voltage = QUANTIZERS[cell.quantizer] if cell.quantizer else (None, None, None)
    try:
        chosen = WireSpec(
            attitude=_quantized(wire.attitude, out, attitude),
            rate=_quantized(wire.rate, out, rate),
            voltage=_quantized(wire.voltage, inp, voltage),
            actuators=wire.actuators,
            transmit=Transmit(heartbeat_s=wire.transmit.heartbeat_s),
            counter_bits=wire.counter_bits,
        )
        sensors = plant.sensors.model_copy(update=SENSORS[cell.sensors].changes)
        measured = type(plant).model_validate({**plant.model_dump(), "sensors": sensors.model_dump()})
    except ValidationError as error:
        why = problem(error, SignalSpec, WireSpec, type(plant))
        bits = "/".join("cont" if one is None else str(one) for one in (out, inp))
        raise BurdenError(f"{bits} {cell.quantizer or 'float64'} with sensors {cell.sensors}: {why}") from None
    return settings.model_copy(update={"wire": chosen, "plant": measured})


def _quantized(signal: SignalSpec, bits: int | None, kind: Kind | None) -> SignalSpec:
    """A signal with other bits and another quantizer; parameters stay if the kind stays."""
    if kind in (None, signal.kind):
        return signal.with_bits(bits)
    return SignalSpec(bits=bits, limit=signal.limit, kind=kind)


def _pair(text: str) -> _Bits:
    words = text.split("/") if text != "cont" else [text] * 2
    if len(words) != 2 or not all(
        word == "cont" or (word.isdecimal() and MIN_BITS <= int(word) <= MAX_BITS) for word in words
    ):
        raise BurdenError(f"--bits takes bits out and in, {MIN_BITS} to {MAX_BITS} or cont, such as 8/6, not {text!r}")
    out, inp = (None if word == "cont" else int(word) for word in words)
    return out, inp


def _chosen(option: str, names: Sequence[str], choices: Collection[str]) -> list[str]:
    """The names without repetitions, or all choices if there are none."""
    for name in names:
        if name not in choices:
            raise BurdenError(f"{option} takes {', '.join(choices)}, not {name!r}")
    return list(dict.fromkeys(names or choices))
