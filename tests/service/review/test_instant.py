"""One tick of a log: what stands in its frames, what the law computed, and the next at which a condition holds."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from aeroloop.service.config import load
from aeroloop.service.control.laws.adaptive import AdaptiveSettings, equations
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.instant import Instants
from aeroloop.service.review.review import read
from tests.golden.make import HERE as GOLDEN
from tests.support.made_log import lockstep, make_log

Floats = npt.NDArray[np.float64]
TICK = 2001


@pytest.fixture(scope="module")
def run() -> Instants:
    return Instants([GOLDEN / "default.mcap"])


@pytest.fixture(scope="module")
def ticks() -> Ticks:
    return read(GOLDEN / "default.mcap").ticks


def test_the_bits_of_a_frame_are_its_codes_and_the_codes_its_levels(run: Instants, ticks: Ticks) -> None:
    found, i = run.at(TICK), int(np.searchsorted(ticks.k, TICK))
    assert (found.tick, found.time_s, found.session) == (TICK, 4.002, "1421f00c")
    assert found.measurement.octets == "d1 ec 24 3a ef 04 16"
    assert "".join(signal.bits for signal in found.measurement.signals) == f"{0xEC243AEF0416:048b}"
    assert [signal.level for signal in found.measurement.signals[3:]] == ticks.rate[i].tolist()
    assert [signal.level for signal in found.command.signals] == ticks.voltages[i].tolist()
    assert (found.measurement.counter, found.command.counter) == (TICK % 256, TICK % 256)
    assert (found.measurement.received_as, found.command.received_as) == ("received as frame", "acted")
    assert found.values["unquantized_voltage_3_V"] == ticks.unquantized[i][1]
    assert found.gains == {"C1": [0.3] * 3, "C2": [0.2] * 3, "Gamma": [0.02] * 3}  # an operator's, since tick 2000
    assert found.state_after["damping_estimate"] == ticks.state_next[i][:3].tolist()
    assert next(mark.text for mark in found.events if mark.kind == "change") == "C2 = [0.2, 0.2, 0.2]"
    assert found.notes == []


def test_z1_z2_and_v_are_those_of_the_laws_equations(run: Instants, ticks: Ticks) -> None:
    found, i = run.at(TICK).coordinates, int(np.searchsorted(ticks.k, TICK))
    law = run.settings.law
    assert isinstance(law, AdaptiveSettings)
    omega_d = in_inertial_frame(ticks.attitude[i], ticks.desired_rate[i])
    names = ("q", "omega", "q_d", "omega_d", "omega_d_dot", "theta", "s", "C1", "C2", "Gamma")
    values = (
        ticks.attitude[i], ticks.rate[i], ticks.desired[i], omega_d, [0.0] * 3, ticks.state[i][:3], 1.0,
        *np.split(ticks.gains[i], 3),
    )  # fmt: skip
    expected = equations(law, 2, {name: ca.SX(ca.DM(value)) for name, value in zip(names, values, strict=True)})
    z1, z2 = (np.array(ca.evalf(expected[name])).ravel() for name in ("z1", "z2"))
    assert found["z1"] == pytest.approx(z1, abs=1e-15)
    assert found["z2"] == pytest.approx(z2, abs=1e-15)
    pitch, yaw = run.settings.plant.friction.viscous  # damping of the joints, as about the body's axes
    error = np.array([yaw, pitch, yaw]) - ticks.state[i][:3]
    V = z1 @ z1 + z2 @ (np.array(law.inertia) * z2) / 2 + error @ (error / 0.02) / 2  # (C.24)
    assert found["V"] == [pytest.approx(V, rel=1e-12)]


def in_inertial_frame(q: Floats, rate: Floats) -> Floats:
    """A rate in the body frame, turned by q."""
    return np.asarray(rate + 2 * q[0] * np.cross(q[1:], rate) + 2 * np.cross(q[1:], np.cross(q[1:], rate)))


def test_the_next_tick_at_which_a_condition_holds_is_found(run: Instants, ticks: Ticks) -> None:
    large = 2 * np.degrees(np.arcsin(np.linalg.norm(ticks.attitude_error, axis=1)))
    for limit in (1.0, 3.0, 4.0):
        expected = ticks.k[(large > limit) & (ticks.k > 10)]
        assert run.find(f"attitude_error_deg > {limit}", 10) == (expected[0] if len(expected) else None)
    assert run.find("attitude_error_deg > 90", 0) is None
    assert (run.find("trip", 0), run.find("fault", 0), run.find("change", 100)) == (4499, 2499, 2000)
    assert run.find("trip", 4499) is None
    assert run.find("mark", 0) is None
    for wrong, line in (
        ("attitude_error > 3", "has no column attitude_error; it has attitude_error_"),
        ("vehicle == 3", "has no column vehicle"),
        ("attitude_error_deg > five", "five is no number"),
        ("whatever happens", "no condition: whatever happens; one is 'attitude_error_deg > 5'"),
    ):
        with pytest.raises(ReviewError, match=line):
            run.find(wrong, 0)
    with pytest.raises(ReviewError, match=r"ticks 0 to 4499, 0 s to 8.998 s, and none 4500"):
        run.at(9.0)


def test_silence_repeats_the_last_frame_and_what_is_missing_is_said(tmp_path: Path) -> None:
    silent = Instants([GOLDEN / "on-change.mcap"])
    tick = next(k for k in range(1500, 1600) if silent.at(k).command.sent_as == "silent")
    found, before = silent.at(tick), silent.at(tick - 1)
    assert [one.code for one in found.command.signals] == [one.code for one in before.command.signals]
    make_log(tmp_path / "a.mcap", 200, settings=load(), lost={100})
    lossy = Instants([tmp_path / "a.mcap"])
    nothing = "no command that answers this measurement acted"
    assert lossy.at(100).notes == [nothing, "the log lacks the controller's row"]
    assert lossy.at(100).command.sent_as == "missing"
    assert lossy.at(100).state_after == {}  # the law did nothing
    assert lossy.at(101).state_after["damping_estimate"] != lossy.at(99).state_after["damping_estimate"]
    assert lossy.at(0.202).values["latency_us"] == pytest.approx(300, abs=1)
    sent, received = (lossy.at(101).clocks_s[name] for name in ("plant sent the measurement", "plant received it"))
    assert sent is not None
    assert received is not None
    assert received - sent == pytest.approx(300e-6, abs=1e-6)
    full = Instants([_saturated(tmp_path)])
    assert full.at(50).notes == ["at the quantizer's outermost level: voltage_2, voltage_3"]


def _saturated(folder: Path) -> Path:
    """A log of a reference that is a step away."""
    make_log(folder / "s.mcap", 60, settings=lockstep("reference.kind=hold", "reference.attitude=[0,40,90]"))
    return folder / "s.mcap"
