"""Certificate: the paper's formulas by hand, the effect of bits and assumptions, and the text of a failed one."""

from __future__ import annotations

import json
from math import acos, asin, cos, degrees, hypot, pi, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.operator import Hold, Points, Reference, Sinusoid, Stream
from aeroloop.protocol.wire.attitude import IDENTITY, received_quaternion, sent_vector
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import Settings, load, load_over
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.law import LawSettings
from aeroloop.service.control.reference import Plan, reference_function
from aeroloop.service.settings import ControllerSettings
from aeroloop.service.theorem.bounds import attitude_error
from aeroloop.service.theorem.certificate import Certificate, bounds_of, certify
from aeroloop.service.theorem.extremes import BoundlessError, extremes
from aeroloop.service.theorem.lemma import Samples, coordinates, lemma_inequalities
from tests.support import numpy_twin as twin

PAPER = Settings()
EXAMPLES = Path(__file__).parents[3] / "service" / "examples"
STILL = Hold(attitude=(0.0, 0.0, 0.0))
KEYS = ["holds", "margin", "c0", "delta_V1", "delta_V2", "delta_Q", "k", "radius", "radius_deg", "terms"]


def certificate(settings: Settings, **options: Any) -> Certificate:
    return certify(settings.wire, settings.law, settings.reference, settings.controller, **options)


def with_bits(out: int | None, inp: int | None) -> Settings:
    return PAPER.model_copy(update={"wire": PAPER.wire.with_bits(out, inp)})


def test_the_paper_s_experiment_agrees_with_its_formulas_worked_by_hand() -> None:
    """8 and 6 bits, an attitude error of at most 90° assumed; plain arithmetic from (C.58) to (C.72), (C.80)."""
    found = certificate(PAPER, attitude_error_deg=90.0, disturbance=0.01)

    d_eps = d_omega = sqrt(3) / 255  # l = 2/(2⁸ − 1), half of it on each of three axes
    d_u = sqrt(2) * 24 / 63  # two motors
    J, weight, C1, C2, k_theta = 0.0218, 0.0038 * 1.075 * 9.81, 0.3, 0.15, 0.05
    # ‖B‖² is the larger root of x² − tr(BᵀB) x + det(B)².
    trace = 0.0011**2 + 0.0011**2 + 0.0014**2 + 0.00176**2
    det = 0.0011 * 0.00176 + 0.0014 * 0.0011
    B = sqrt((trace + sqrt(trace**2 - 4 * det**2)) / 2)
    # At t = 0 pitch and yaw are fastest, about axes at right angles. Samples are trusted to half a percent.
    k_wd = 1.005 * sqrt((radians(40) * 0.1 * pi) ** 2 + (radians(100) * 0.05 * pi) ** 2)
    # q may turn by 50° + 45°, halved, from [1, 0]: past 90°, so ε^Q of length 1 may stand for an ε that is shorter.
    d_q = sqrt(d_eps**2 + (1 - (1 - d_eps) ** 2))
    k_we = 1 + C1
    d_R = 2 * (d_q + d_q**2)
    d_we = d_R * k_wd + d_omega
    d_z1 = d_q
    d_z2 = d_we + C1 * d_q
    d_psi1, d_psi2 = J * (2 * k_wd * d_omega + d_omega**2) + weight * d_R, 2 * J * d_omega * k_we
    d_S1, d_S2 = k_wd * d_R + d_omega, k_we * d_R
    d_alpha1, d_alpha2 = C1 * d_we / 2, C1 * k_we
    V1 = d_psi2 + d_S2 * J * k_wd + d_alpha2 * J
    k_theta_err = k_theta + k_theta / 0.95  # θ within k_θ, θ̂ within the projection's outer ball
    theta1 = k_theta_err * d_z2 * (d_omega + k_wd)
    theta2 = k_theta * d_omega + k_theta_err * k_we * d_z2
    k_wdd = found.value("k_ω̇_d")
    assert k_wdd is not None
    V2 = C2 * d_z2 + d_z1 + d_psi1 + d_S1 * J * k_wd + d_R * J * k_wdd + d_alpha1 * J + theta2 + d_u * B
    c0 = 0.15  # of C₂; C₁ gives at least 0.3 (1 + 0)/2, as much
    Q = theta1 + (V2 + 0.01) ** 2 / (2 * c0)
    k = c0 / 2 - V1

    by_hand = {
        "‖B‖": B, "k_ω_d": k_wd, "‖r_g‖ m g": weight, "‖δ_u‖": d_u, "k_ε‖δ_ε‖": d_q, "k_ε": d_q / d_eps, "k_ω_e": k_we,
        "δ_R": d_R, "‖δ_ω_e‖": d_we, "δ_z1": d_z1, "‖δ_z2‖": d_z2, "δ_Ψ1": d_psi1, "δ_Ψ2": d_psi2, "δ_S1": d_S1,
        "δ_S2": d_S2, "δ_ᾱ1": d_alpha1, "δ_ᾱ2": d_alpha2, "δ_ω": d_omega, "δ_Bu": d_u * B, "c₀": c0, "δ_V1": V1,
        "δ_θ1": theta1, "δ_θ2": theta2, "δ_V2": V2, "δ_Q": theta1 + V2**2 / (2 * c0), "δ_Qdist": Q, "k": k,
        "√(δ_Q/k)": sqrt(Q / k),
    }  # fmt: skip
    assert {symbol: found.value(symbol) for symbol in by_hand} == pytest.approx(by_hand)
    assert found.holds
    assert (found.margin, found.k) == pytest.approx((k, k))
    assert (found.c0, found.delta_V1, found.delta_V2, found.delta_Q) == pytest.approx((c0, V1, V2, Q))
    assert (found.radius, found.radius_deg) == pytest.approx((sqrt(Q / k), degrees(4 * asin(sqrt(Q / k) / 2))))


def test_a_body_at_rest_near_its_reference_agrees_with_the_formulas_worked_by_hand() -> None:
    """No ω_d, no weight, three motors, an error of at most 60°: k_ε is then 1/cos 30° but for second order."""
    law = LawSettings(
        inertia=(0.02, 0.03, 0.01), centre_of_mass=(0, 0, 0), allocation=((0.01, 0, 0), (0, 0.02, 0), (0, 0, 0.01)),
        C1=(0.2, 0.1, 0.2), C2=(0.3, 0.2, 0.2), damping_estimate=(0, 0, 0), damping_bound=0.01,
    )  # fmt: skip
    wire = WireSpec(
        actuators=3,
        attitude=SignalSpec(bits=12, limit=1),
        rate=SignalSpec(bits=10, limit=3, deadzone=0.004),
        voltage=SignalSpec(bits=10, limit=10),
    )
    found = certify(wire, law, STILL, ControllerSettings(), attitude_error_deg=60)
    d_eps, d_omega, d_u = sqrt(3) / 4095, sqrt(3) * 0.004, sqrt(3) * 10 / 1023
    d_q = d_eps / cos(radians(30))
    d_z2 = d_omega + 0.2 * d_q
    c0 = min(0.1 * (1 + cos(radians(30))) / 2, 0.2)
    V1 = 2 * 0.03 * d_omega * 1.2 + 0.2 * 1.2 * 0.03
    V2 = 0.3 * d_z2 + d_q + 0.03 * d_omega**2 + 0.2 / 2 * d_omega * 0.03
    k_theta_err = 0.01 + 0.01 / 0.95
    V2 += 0.01 * d_omega + k_theta_err * 1.2 * d_z2 + d_u * 0.02
    Q = k_theta_err * d_z2 * d_omega + V2**2 / (2 * c0)
    assert (found.c0, found.delta_V1) == pytest.approx((c0, V1), rel=1e-9)
    assert (found.delta_V2, found.delta_Q) == pytest.approx((V2, Q), rel=1e-4)  # k_ε's second order
    assert found.radius == pytest.approx(sqrt(Q / (c0 / 2 - V1)), rel=1e-4)


def test_the_paper_s_experiment_holds_and_certifies_itself_as_json(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(("lab", "certify", "--json")) == 0
    found = json.loads(capfd.readouterr().out)
    assert list(found) == [*KEYS, "blame", "remedies"]
    assert all(set(term) == {"symbol", "equation", "value", "unit", "meaning"} for term in found["terms"])
    assert len({term["symbol"] for term in found["terms"]}) == len(found["terms"])
    equations = {number for term in found["terms"] for number in term["equation"].replace(",", " ").split()}
    numbers = {f"C.{n}" for n in range(50, 73)}
    assert numbers - equations == set()
    assert found["holds"]
    assert found["margin"] == found["k"] == pytest.approx(found["c0"] / 2 - found["delta_V1"])
    assert found["radius"] == pytest.approx(sqrt(found["delta_Q"] / found["k"]))
    assert found["blame"] is None
    assert found["remedies"] == []


@pytest.mark.parametrize("signal", ["attitude", "rate", "voltage", "all"])
@pytest.mark.parametrize("option", [None, 180.0], ids=["default", "nothing assumed"])
def test_more_bits_are_never_worse(signal: str, option: float | None) -> None:
    last: Certificate | None = None
    for bits in (*range(4, 17), None):
        wire = PAPER.wire.model_dump()
        for name in ("attitude", "rate", "voltage") if signal == "all" else (signal,):
            wire[name]["bits"] = bits
        now = certificate(PAPER.model_copy(update={"wire": WireSpec.model_validate(wire)}), attitude_error_deg=option)
        if last is not None:
            assert now.margin >= last.margin
            assert now.radius is not None
            assert last.radius is not None
            assert now.radius < last.radius
        last = now


def test_without_quantization_the_error_goes_to_0_and_only_the_gain_takes_from_the_damping() -> None:
    found = certificate(with_bits(None, None))
    assert found.holds
    assert (found.radius, found.radius_deg, found.delta_V2, found.delta_Q) == (0, 0, 0, 0)  # Remark 7
    assert found.delta_V1 == pytest.approx(0.3 * 1.3 * 0.0218)
    assert "goes to 0" in found.verdict
    windy = certificate(with_bits(None, None), disturbance=0.003)
    assert windy.k is not None
    assert windy.radius == pytest.approx(0.003 / sqrt(2 * windy.c0 * windy.k))  # (C.79), (C.80)


def test_the_assumed_error_is_widened_until_it_agrees_with_the_guaranteed_one() -> None:
    found = certificate(PAPER, attitude_error_deg=5.0)
    assumed = 2 * degrees(found.value("max ∡e/2") or 0)
    assert found.radius_deg == pytest.approx(assumed, rel=1e-6)
    assert assumed > 5
    assert certificate(PAPER, attitude_error_deg=2 * assumed).radius > found.radius  # type: ignore[operator]
    narrow = certificate(with_bits(12, 12))
    assert narrow.value("max ∡e/2") == pytest.approx(radians(PAPER.controller.start_within_deg / 2))


def test_c0_is_the_least_share_of_z1_that_the_gain_reaches() -> None:
    """The correction of (C.66), against random errors: z₁ᵀGᵀC₁Gz₁ = ε̃ᵀC₁ε̃ ≥ c₀ ‖z₁‖², and c₀ is all but attained."""
    law = LawSettings(C1=(0.3, 0.1, 0.2), C2=(9, 9, 9))
    most = radians(100)
    c0 = certify(
        PAPER.wire.with_bits(None, None), law, STILL, ControllerSettings(), attitude_error_deg=degrees(most)
    ).c0
    rng = np.random.default_rng(0)
    half, axis = most / 2 * rng.random(20_000), rng.standard_normal((20_000, 3)) * [0.1, 1, 0.1]
    eps = axis / np.linalg.norm(axis, axis=1, keepdims=True) * np.sin(half)[:, None]
    share = (eps**2 @ law.C1) / (2 - 2 * np.cos(half))
    assert share.min() >= c0
    assert share.min() < 1.02 * c0


@pytest.mark.parametrize("bits", [4, 8])
@pytest.mark.parametrize("half_deg", [20.0, 60.0, 89.0, 90.0])
def test_no_attitude_errs_by_more_than_k_eps_says_and_some_by_nearly_as_much(bits: int, half_deg: float) -> None:
    quantizer = SignalSpec(bits=bits, limit=1).quantizer()
    bound = attitude_error(sqrt(3) * quantizer.bound, radians(half_deg))
    rng = np.random.default_rng(bits)
    axis = rng.standard_normal((4000, 3))
    axis[::2] = 1 + 0.02 * axis[::2]  # along the diagonal all three components err outwards at once
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = radians(half_deg) * rng.random(4000) ** 0.1
    worst = 0.0
    for w, *eps in np.hstack([np.cos(half)[:, None], np.sin(half)[:, None] * axis]).tolist():
        x, y, z = map(quantizer.quantize, eps)
        worst = max(worst, float(np.linalg.norm(np.subtract(received_quaternion(x, y, z, IDENTITY), (w, *eps)))))
    assert 0.6 * bound < worst <= bound


@pytest.mark.parametrize(
    "reference",
    [
        Sinusoid(),
        Sinusoid(amplitude=(20, 30, 60), frequency=(0.4, 0.3, 0.15)),
        Points(times=[0, 2, 5, 6], attitudes=[(0, 0, 0), (10, 20, 70), (-15, 30, 150), (0, 0, 160)]),
    ],
    ids=["paper", "three axes", "points"],
)
def test_the_extremes_of_a_reference_are_those_of_what_the_law_is_given(reference: Reference) -> None:
    bounds, plan, function = extremes(reference), Plan.of(reference), Compiled(reference_function())
    most = [0.0, 0.0, 0.0]
    for t in np.linspace(0, 6.5 if isinstance(reference, Points) else 140, 20_000).tolist():
        i = plan.piece(t)
        for name in ("quintic", "amplitude", "frequency"):
            function.inputs[name][:] = memoryview(getattr(plan, name)[i].ravel().copy())
        function.inputs["start"][0], function.inputs["t"][0] = plan.starts[i], t
        function()
        rate, acceleration = (hypot(*function.outputs[name]) for name in ("omega_d", "omega_d_dot"))
        half_angle = acos(min(1.0, abs(function.outputs["q_d"][0])))
        most = [*map(max, most, (rate, acceleration, half_angle))]
    assert np.all(np.array(most) < bounds)
    assert np.all(np.array(most) > 0.985 * np.array(bounds))


def test_a_stream_is_not_certified_and_the_reason_is_reported(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BoundlessError, match="not known beforehand"):
        extremes(Stream())
    with pytest.raises(BoundlessError, match="too fast for floating-point numbers"):
        extremes(Sinusoid(amplitude=(0, 1e308, 0), frequency=(0, 100, 0)))
    assert run(("lab", "certify", "--set", "reference.kind=stream")) == 1
    assert capfd.readouterr().err.startswith("aeroloop: a stream's set-points")


COARSE = ["wire.rate.limit=20", "wire.rate.bits=4"]


@pytest.mark.parametrize(
    ("overrides", "to_blame"),
    [
        (COARSE, "δ_Ψ2"),
        (["law.C1=[2, 2, 2]"], "δ_ᾱ2"),
        (["law.C2=[0.01, 0.02, 0.01]"], "δ_ᾱ2"),
        (["wire.rate.limit=0.3"], "wire.rate.limit"),
        (["wire.attitude.limit=0.5", "wire.attitude.bits=12"], "wire.attitude.limit"),
    ],
    ids=["coarse rate", "large C1", "small C2", "narrow rate", "narrow attitude"],
)
def test_one_that_fails_names_what_is_to_blame_and_each_remedy_cures_it(overrides: list[str], to_blame: str) -> None:
    settings = load_over(PAPER, overrides)
    found = certificate(settings)
    assert not found.holds
    assert found.blame is not None
    assert to_blame in found.blame
    assert found.blame in found.verdict
    cures = [remedy.overrides for remedy in found.remedies if remedy.overrides]
    assert cures
    for cure in cures:
        assert certificate(load_over(settings, cure)).holds, cure


def test_a_remedy_by_bits_is_the_fewest_that_do_and_by_gain_the_least_change() -> None:
    settings = load_over(PAPER, [*COARSE, "law.C1=[0.4, 0.4, 0.4]"])
    remedies = {remedy.overrides[0].partition("=")[0]: remedy.overrides for remedy in certificate(settings).remedies}
    rate = int(remedies["wire.rate.bits"][0].partition("=")[2])
    assert certificate(load_over(settings, [f"wire.rate.bits={rate}"])).holds
    assert not certificate(load_over(settings, [f"wire.rate.bits={rate - 1}"])).holds
    everything = {change.partition("=")[0]: int(change.partition("=")[2]) for change in remedies["wire.attitude.bits"]}
    assert list(everything) == ["wire.attitude.bits", "wire.rate.bits", "wire.voltage.bits"]
    fewer = [f"{name}={bits - 1}" for name, bits in everything.items()]
    assert not certificate(load_over(settings, fewer)).holds

    slow = load_over(PAPER, ["law.C2=[0.01, 0.01, 0.01]"])
    gains = [float(c.partition("[")[2].partition(",")[0]) for r in certificate(slow).remedies for c in r.overrides]
    for name, before, gain in zip(("C1", "C2"), (0.3, 0.01), gains, strict=True):
        almost = gain + 0.01 * (before - gain)
        assert not certificate(load_over(slow, [f"law.{name}=[{almost}, {almost}, {almost}]"])).holds


@pytest.mark.parametrize("gain", [0.0077, 0.0091, 0.0123, 0.0151])
def test_a_gain_that_is_printed_with_four_digits_still_cures(gain: float) -> None:
    settings = load_over(PAPER, [f"law.C2=[{gain}, {2 * gain}, {3 * gain}]"])
    cures = [remedy.overrides for remedy in certificate(settings).remedies if remedy.overrides]
    assert len(cures) == 2
    for cure in cures:
        assert certificate(load_over(settings, cure)).holds, cure


def test_where_no_bits_and_no_gains_suffice_it_is_reported() -> None:
    found = certificate(load_over(PAPER, ["law.inertia=[1, 1, 1]"]))
    assert [r.text for r in found.remedies] == ["no number of bits up to 16 would do", "no gains C1 and C2 would do"]
    assert (found.k, found.radius, found.radius_deg) == (None, None, None)


def test_the_verdict_comes_first_and_the_exit_code_follows_it(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(("lab", "certify", "--disturbance", "0.004")) == 0
    shown = capfd.readouterr().out
    assert shown.startswith("Corollary 1, with ‖τ_d‖ ≤ 0.004 N·m, holds: ")
    assert "Remark 5" not in shown  # of all terms, which --verbose prints
    assert run(("lab", "certify", "--disturbance", "0.004", "--verbose")) == 0
    assert "Remark 5" in capfd.readouterr().out
    assert run(("lab", "certify", "--bits-out", "cont", "--bits-in", "cont")) == 0
    shown = " ".join(capfd.readouterr().out.split())
    assert shown.startswith("Theorem 1 holds: ")
    assert "the error goes to 0." in shown
    assert run(("lab", "certify", "--set", "law.C1=[2, 2, 2]")) == 1
    shown = capfd.readouterr().out
    assert shown.startswith("Theorem 1 does not hold: ")
    assert "--set 'law.C1=" in shown
    assert run(("lab", "certify", "--disturbance", "-1")) == 2
    assert run(("lab", "certify", "--disturbance", "inf")) == 1


@pytest.mark.parametrize(("kind", "bits"), [("uniform", 8), ("hysteresis-uniform", 9), ("logarithmic-uniform", 9)])
def test_an_ideal_body_ends_within_the_radius_and_breaks_no_inequality_on_its_way(kind: str, bits: int) -> None:
    """The example of a free body in the real loop, 15° from its reference at the start.

    The kinds that err by twice as much have one bit more, which halves that.
    """
    off = f"plant.rigid_body.attitude=[{cos(radians(7.5))}, 0, {sin(radians(7.5))}, 0]"
    wire = ["wire.voltage.bits=8"] if kind == "uniform" else []
    for signal in () if kind == "uniform" else ("attitude", "rate", "voltage"):
        wire += [f"wire.{signal}.kind={kind}", f"wire.{signal}.bits={bits}"]
    settings = load_over(load(EXAMPLES / "rigid-body.toml"), [off, *wire])
    bounds = bounds_of(settings.wire, settings.law, settings.reference, settings.controller)
    samples = _run(settings, duration_s=16)
    inequalities = lemma_inequalities(samples, settings.law, bounds.known, bounds.lemma)
    assert {i.equation: int(i.broken.sum()) for i in inequalities if i.broken.any()} == {}
    x, radius = samples, bounds.theorem.radius
    z = coordinates(x.q, x.omega, x.q_d, x.omega_d, x.sign, np.array(settings.law.C1)).norm
    assert radius is not None
    assert z[0] > radius
    assert z[len(z) // 2 :].max() < radius


def _run(settings: Settings, duration_s: float) -> Samples:
    """What is true of the emulated plant and what the controller has of it, at every tick."""
    loop, wire = settings.loop, settings.wire
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    plant = settings.plant.build(loop.period)
    attitude, rate, voltage = (
        [signal.quantizer() for _ in range(3)] for signal in (wire.attitude, wire.rate, wire.voltage)
    )
    rows = []
    for k in range(loop.ticks(duration_s)):
        measured, true = plant.measure(), plant.truth()
        values = [*sent_vector(measured.attitude), *measured.rate]
        codes = [quantizer.encode(value) for quantizer, value in zip([*attitude, *rate], values, strict=True)]
        u = controller.compute(k % 16, codes, k)
        assert u is not None
        omega_d = twin.rotation(np.array(controller.attitude)) @ np.subtract(controller.rate, controller.rate_error)
        known = true.attitude, true.rate, controller.attitude, controller.rate, controller.desired, omega_d
        rows.append([*(value for part in known for value in part), controller.sign])
        plant.actuate([quantizer.quantize(value) for quantizer, value in zip(voltage, u, strict=True)])
        plant.advance()
    assert not any(quantizer.saturated for quantizer in voltage)
    q, omega, q_Q, omega_Q, q_d, omega_d, sign = np.split(np.array(rows), [4, 7, 11, 14, 18, 21], axis=1)
    return Samples(q, omega, q_Q, omega_Q, q_d, omega_d, sign[:, 0])
