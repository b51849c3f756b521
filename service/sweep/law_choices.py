"""Choices of a comparison of laws: every law × bits × sensors × wind × plant as a configuration of a sweep.

A law that is not the configured one has the gains of the tuning rule, from the bandwidth and damping ratio of the
configured C₁ and C₂; a law of one's own has its defaults. Everything else is the same for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, Final, NamedTuple

from aeroloop.plant_emulator.settings import IDEAL_AERO
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.baselines import NonadaptiveSettings, TrackingSettings
from aeroloop.service.control.laws.tuning import RULES, Response, response_of, tuned
from aeroloop.service.lab.burden_grid import SENSORS
from aeroloop.service.sweep.axes import Axis, Configuration, digest_of
from aeroloop.service.sweep.sweep import Plan

LAWS: Final = ("adaptive", "nonadaptive", *RULES)
BITS: Final = ("8/6", "cont/cont")
WINDS: Final = {"calm": False, "wind": True}
PLANTS: Final = ("aero", "rigid_body")
WITHIN_DEG: Final = 10.0
AS_CONFIGURED: Final = "its own"
"""Sensors and wind of a plant that is none of ours."""
IDEAL: Final = "ideal"
"""Those of an ideal plant of ours: perfect sensors, no wind."""


class Choice(NamedTuple):
    """A combination, in words."""

    law: str
    bits: str
    sensors: str
    wind: str
    plant: str


class LawsError(AeroloopError):
    """The comparison cannot be made; one line with the reason."""


class Comparison(NamedTuple):
    """What is to be run."""

    plan: Plan
    choices: list[Choice]
    response: Response
    within_deg: float


def compare(
    settings: Settings,
    laws: Sequence[str] = (),
    bits: Sequence[str] = (),
    sensors: Sequence[str] = (),
    winds: Sequence[str] = (),
    plants: Sequence[str] = (),
    *,
    seeds: int = 1,
    duration_s: float,
    within_deg: float = WITHIN_DEG,
) -> Comparison:
    """Every combination of what is given.

    Where nothing is: the configured law and LAWS, BITS, encoders, WINDS, and PLANTS or a configured other plant.

    Args:
        settings: The configuration.
        laws: Kinds of laws, also of one's own.
        bits: Bits out and in, such as 8/6; `cont` for float64.
        sensors: Names out of SENSORS.
        winds: Names out of WINDS.
        plants: Kinds of plants, also of one's own.
        seeds: Runs of each combination, with seeds from 0 up.
        duration_s: Length of an experiment [s].
        within_deg: Bound of the attitude error, for the margins [deg].

    Raises:
        LawsError: An unknown name.
        ConfigError, PluginError, LawError: A combination is no configuration, or has no such law.
    """
    for option, given, known in (("--sensors", sensors, [*SENSORS]), ("--wind", winds, [*WINDS])):
        if unknown := [name for name in given if name not in known]:
            raise LawsError(f"{option} {unknown[0]!r} is not known: it is one of {', '.join(known)}")
    if wrong := [pair for pair in bits if pair.count("/") != 1]:
        raise LawsError(f"--bits takes bits out and in, such as 8/6 or cont/cont, not {wrong[0]!r}")
    found = list[tuple[Choice, Configuration]]()
    chosen = plants or (PLANTS if settings.plant.kind == PLANTS[0] else (settings.plant.kind,))
    axes = chosen, sensors or ("encoders",), winds or WINDS, bits or BITS
    for plant, sensor, wind, pair in product(*map(dict.fromkeys, axes)):
        for law in dict.fromkeys(laws or (settings.law.kind, *LAWS)):
            choice, overrides = _chosen(settings, Choice(law, pair, sensor, wind, plant))
            if all(choice != other for other, _ in found):
                description = with_law_settings(load_over(settings, overrides)).description()
                found.append((choice, Configuration(overrides, choice, digest_of(description, duration_s))))
    choices, configurations = map(list, zip(*found, strict=True))
    names = [Axis(name, ()) for name in Choice._fields]
    return Comparison(
        Plan(settings, names, configurations, seeds, duration_s), choices, _response(settings), within_deg
    )


def _chosen(settings: Settings, choice: Choice) -> tuple[Choice, tuple[str, ...]]:
    """A combination as it can be had, and its overrides: a body without joints has no encoders."""
    out, _, inp = choice.bits.partition("/")
    changes: dict[str, Any] = {
        "wire": {
            "attitude": {"bits": _bits(out)},
            "rate": {"bits": _bits(out)},
            "voltage": {"bits": _bits(inp)},
            "transmit": {"measurement": "on_change", "command": "on_change"},
        },
        "plant": {"kind": choice.plant},
    }
    plant, body = changes["plant"], settings.law
    if choice.plant not in PLANTS:
        choice = choice._replace(sensors=AS_CONFIGURED, wind=AS_CONFIGURED)
        changes["wire"]["actuators"] = _motors(settings, choice.plant)
    elif settings.plant.ideal:
        choice = choice._replace(sensors=IDEAL, wind=IDEAL)
        plant["sensors"], plant["wind"] = {}, {}
    else:
        plant["sensors"] = dict(SENSORS[choice.sensors].changes)
        plant["wind"] = {"blowing": WINDS[choice.wind]}
    if choice.plant == "rigid_body":
        rate = plant["sensors"].get("rate", "perfect")
        plant["sensors"] |= {"attitude": "perfect", "rate": "perfect" if rate == "derivative" else rate}
        choice = choice._replace(sensors={"encoders": "perfect"}.get(choice.sensors, choice.sensors))
        if settings.plant.kind != "rigid_body":
            body = body.model_copy(update={"allocation": three_motors(body.allocation)})
            plant |= _free_body(settings, body.allocation)
            plant["wind"]["torque"] = [0.0, *settings.plant.wind.torque[:2]]  # about y and z, as on the Aero
            changes["wire"]["actuators"] = 3
    law = _law(settings, choice.law, body)
    return choice, tuple(as_overrides({**changes, "law": law}))


def _motors(settings: Settings, kind: str) -> int:
    """Motors of a plant of one's own. Raises PluginError or PlantError if it cannot be made."""
    plant = load_over(settings, [f"plant.kind={kind}"]).plant.make(settings.loop.period)
    plant.close()
    return plant.actuators


def _bits(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def three_motors(allocation: Sequence[Sequence[float]]) -> list[list[float]]:
    """B of a free body like the Aero: its two motors, and one that rolls it as strongly as the others move it."""
    motors = [[float(value) for value in row[1:]] for row in allocation[1:]]
    strongest = max(abs(value) for row in motors for value in row)
    return [[strongest, 0.0, 0.0], *([0.0, *row] for row in motors)]


def _free_body(settings: Settings, allocation: Sequence[Sequence[float]]) -> dict[str, Any]:
    """A plant of the paper's equations: the body of the law's model, with the damping of an ideal Aero."""
    law = settings.law
    same = {name: getattr(law, name) for name in ("inertia", "mass", "gravity", "centre_of_mass")}
    return {
        "rigid_body": {**same, "allocation": allocation, "damping": IDEAL_AERO.damping},
        "rotor": {"lag_up_s": 0.0, "lag_down_s": 0.0},
        "friction": {"viscous": [], "coulomb": []},
    }


def _law(settings: Settings, kind: str, body: Any) -> dict[str, Any]:
    """`[law]` of a law of this kind, over the configuration's."""
    allocation = {"allocation": [list(row) for row in body.allocation]}
    if kind == settings.law.kind:
        return allocation
    papers = isinstance(settings.law, AdaptiveSettings | NonadaptiveSettings)
    known = {}
    if kind in LAWS and isinstance(settings.law, AdaptiveSettings | NonadaptiveSettings | TrackingSettings):
        known["damping_estimate"] = settings.law.damping_estimate
    if kind in ("adaptive", "nonadaptive") and papers:
        known |= {name: getattr(settings.law, name) for name in ("C1", "C2")}
    return {"kind": kind, **allocation, **known, **tuned(kind, body, _response(settings))}


def _response(settings: Settings) -> Response:
    """The response that the configured gains of the paper's law give; those of Table C.1, if it has none."""
    law = settings.law
    gains = law if isinstance(law, AdaptiveSettings | NonadaptiveSettings) else AdaptiveSettings()
    return response_of(law.inertia, gains.C1, gains.C2)
