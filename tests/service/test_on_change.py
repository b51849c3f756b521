"""On-change policy in lockstep: the same figures to the last bit, with fewer frames."""

from __future__ import annotations

from math import cos, sin
from pathlib import Path

import pytest

from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.wire.attitude import sent_vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy, Transmit
from aeroloop.service import examples
from aeroloop.service.config import ConfigError, Settings, bits_overrides, load, load_over
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.figures import Figures
from aeroloop.service.lab.experiment import run_experiment

PERIOD = 0.002
DURATION = 1.5
POLICIES: list[tuple[Policy, Policy]] = [("on_change", "on_change"), ("on_change", "periodic")]
GAPS = ('plant.faults=["rate:off@0.2..0.3", "attitude.z:off@0.6..0.602"]', "plant.limits.max_invalid_s=1")
RIGID_BODY = Path(examples.__path__[0]) / "rigid-body.toml"
LOOPS = {"Aero with gaps": load(overrides=GAPS), "rigid body": load(RIGID_BODY)}


def sending(settings: Settings, measurement: Policy, command: Policy) -> Settings:
    transmit = Transmit(measurement=measurement, command=command)
    return settings.model_copy(update={"wire": settings.wire.model_copy(update={"transmit": transmit})})


def cost_aside(figures: Figures) -> Figures:
    """All that does not count frames."""
    none = figures.measurement.model_copy(update={"frames_per_s": None, "bits_per_s": None})
    return figures.model_copy(update={"measurement": none, "command": none})


@pytest.mark.parametrize(("measurement", "command"), POLICIES)
@pytest.mark.parametrize("bits", ["8/6", "cont/cont"])
@pytest.mark.parametrize("loop", LOOPS)
def test_in_lockstep_the_figures_are_those_of_a_frame_every_tick(
    loop: str, bits: str, measurement: Policy, command: Policy
) -> None:
    settings = load_over(LOOPS[loop], bits_overrides(bits))
    periodic = run_experiment(settings, DURATION)
    sparse = run_experiment(sending(settings, measurement, command), DURATION)
    assert cost_aside(sparse) == cost_aside(periodic)
    for direction, policy in (("measurement", measurement), ("command", command)):
        now, ever = getattr(sparse, direction).frames_per_s, getattr(periodic, direction).frames_per_s
        if policy == "periodic":
            assert now == ever
        elif bits == "cont/cont":  # a float64 may well change at every tick
            assert now <= ever
        else:
            assert 1 / (15 * PERIOD) <= now < 0.9 * ever


# The controller by itself

WIRE = WireSpec(transmit=Transmit(measurement="on_change", command="on_change"))


def controller(wire: WireSpec = WIRE) -> Controller:
    return Controller(wire, AdaptiveSettings(), Sinusoid(), PERIOD)


def measurement(k: int, yaw: float = 0.1) -> bytes:
    attitude, rate = WIRE.attitude.quantizer(), WIRE.rate.quantizer()
    turned = sent_vector((cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)))
    codes = [*(attitude.encode(x) for x in turned), *(rate.encode(0.2) for _ in range(3))]
    return WIRE.measurement.pack(k % 256, codes)


@pytest.mark.parametrize("wire", [WIRE, WireSpec()], ids=["on_change", "periodic"])
def test_an_empty_frame_is_refused_where_it_can_stand_for_nothing(wire: WireSpec) -> None:
    """Before a session's first frame, and on a wire that has a frame every tick."""
    law = controller(wire)
    assert law.tick(UNCHANGED, 0) is None
    assert law.refused == 1
    assert law.attitude_of(UNCHANGED) is None
    assert law.tick(measurement(1), 1)
    answered = law.tick(UNCHANGED, 2)
    assert (answered is None, law.refused, law.attitude_of(UNCHANGED) is None) == (
        (False, 1, False) if wire is WIRE else (True, 2, True)
    )


def test_a_late_measurement_is_held_from_the_next_tick_on_and_malformed_bytes_hold_nothing() -> None:
    late, in_time = controller(), controller()
    for law in (late, in_time):
        law.tick(measurement(0), 0)
        law.tick(UNCHANGED, 1)
    assert late.hold(measurement(1, 0.3))
    assert not late.hold(UNCHANGED)
    assert not late.hold(measurement(1)[:-1])
    assert late.refused == 2
    assert late.tick_index == 1  # nothing was computed
    assert late.tick(UNCHANGED, 2) == in_time.tick(measurement(2, 0.3), 2)


@pytest.mark.parametrize("at", [0, 5, 23])
def test_a_restored_controller_goes_on_with_the_levels_it_held_and_what_it_sent(at: int) -> None:
    """Also between two heartbeats: no byte and no silence differs."""

    def run(law: Controller, ticks: range) -> list[bytes | None]:
        return [law.tick(measurement(k, 0.2) if k in (0, 20) else UNCHANGED, k) for k in ticks]

    law, restored = controller(), controller()
    run(law, range(at))
    restored.restore(ControllerSnapshot.model_validate_json(law.state.model_dump_json()))
    assert run(restored, range(at, 60)) == run(law, range(at, 60))
    assert restored.state == law.state


BOTH = ("wire.transmit.measurement=on_change", "wire.transmit.command=on_change")


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (("plant.watchdog_s=0.05",), "plant.watchdog_s, which is 50 ms"),
        (("controller.stale_s=0.059",), "controller.stale_s, which is 59 ms"),
        (("loop.rate_hz=250", "wire.transmit.heartbeat_s=1"), "508 ms pass without a command"),  # 127 ticks
        (("plant.watchdog_s=0.06", "controller.stale_s=0.06"), None),
        (("loop.rate_hz=5",), None),  # a period alone is longer, and every tick has a frame as ever
        (("loop.lockstep=true", "plant.watchdog_s=0.01"), None),  # silence travels there, and is an answer
        (("wire.transmit.command=periodic", "plant.watchdog_s=0.01"), None),  # each end's own direction counts
    ],
)
def test_a_heartbeat_that_cannot_keep_both_ends_alive_is_refused_in_one_line(
    overrides: tuple[str, ...], names: str | None
) -> None:
    if names is None:
        assert load(overrides=[*BOTH, *overrides]).wire.transmit.heartbeat_s <= 1
        return
    with pytest.raises(ConfigError, match=rf"^wire\.transmit\.heartbeat_s .*{names}") as refused:
        load(overrides=[*BOTH, *overrides])
    assert "\n" not in str(refused.value)
