"""Certificate: the paper's formulas by hand, the effect of bits and assumptions, and the text of a failed one."""

from __future__ import annotations

import json
from dataclasses import replace
from math import degrees, hypot, inf, pi, radians, sqrt

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Freshness
from aeroloop.protocol.messages.operator import Hold, Points
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import Settings, load_over
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.theorem.bounds import Known, lemma_1, theorem_1
from aeroloop.service.theorem.certificate import RESOLUTION_S, Patience, certify, evaluate, patience_of
from tests.support.certified import FREE, bits, certified_settings
from tests.support.ideal import IDEAL

PAPER = Settings()
TOO_TILTED = ("reference.amplitude=[20, 80, 60]", "reference.frequency=[0.1, 0.05, 0.03]")
SMALL = ["law.damping_bound=0.0119"]


def known_of(settings: Settings, error_deg: float, disturbance: float = 0.0) -> Known:
    """The theorem's inputs, with an assumed bound of the attitude error."""
    paper = evaluate(settings, disturbance=disturbance).paper
    assert paper is not None
    return replace(paper.known, half_angle_e=radians(error_deg) / 2)


def test_the_paper_s_experiment_agrees_with_its_formulas_worked_by_hand() -> None:
    """8 and 6 bits, an attitude error of at most 90° assumed; plain arithmetic from (C.58) to (C.72), (C.80)."""
    known = known_of(PAPER, 90, disturbance=0.01)
    lemma = lemma_1(known)
    found = vars(known) | vars(lemma) | vars(theorem_1(known, lemma))

    d_eps = d_omega = sqrt(3) / 255  # l = 2/(2⁸ − 1), half of it on each of three axes
    d_u = sqrt(2) * 24 / 63  # two motors
    J, weight, C1, C2, k_theta = 0.0218, 0.0038 * 1.075 * 9.81, 0.3, 0.15, 0.03
    # ‖B‖² is the larger root of x² − tr(BᵀB) x + det(B)².
    trace = 0.0011**2 + 0.0011**2 + 0.0014**2 + 0.00176**2
    det = 0.0011 * 0.00176 + 0.0014 * 0.0011
    B = sqrt((trace + sqrt(trace**2 - 4 * det**2)) / 2)
    # At t = 0 pitch and yaw are fastest, about axes at right angles.
    k_wd = sqrt((radians(40) * 0.1 * pi) ** 2 + (radians(100) * 0.05 * pi) ** 2)
    # q may turn by 50° + 45°, halved, from [1, 0]: past 90°, so ε^Q of length 1 may stand for an ε that is shorter.
    d_q = sqrt(d_eps**2 + (1 - (1 - d_eps) ** 2))
    k_we, theta_err = sqrt(1 + C1**2), k_theta + k_theta / 0.95
    d_R = 2 * (d_q + d_q**2)
    d_we = d_R * k_wd + d_omega
    d_z2 = d_we + C1 * d_q
    d_psi1, d_psi2 = J * (2 * k_wd * d_omega + d_omega**2) + weight * d_R, 2 * J * d_omega * k_we
    d_S1, d_S2 = k_wd * d_R + d_omega, k_we * d_R
    d_alpha1, d_alpha2 = C1 * d_we / 2, C1 * d_q * k_we / 2
    V1 = d_psi2 + d_S2 * J * k_wd + d_alpha2 * J
    theta1 = theta_err * d_z2 * (d_omega + k_wd)
    theta2 = (hypot(0.0070, 0.0095) + k_theta) * d_omega + theta_err * k_we * d_z2
    V2 = C2 * d_z2 + d_q + d_psi1 + d_S1 * J * k_wd + d_R * J * known.k_omega_d_dot + d_alpha1 * J + theta2 + d_u * B
    c0 = 0.15  # of C₂; C₁ gives at least 0.3 (1 + 0)/2, as much
    by_hand = {
        "norm_B": B, "k_omega_d": k_wd, "weight": weight, "delta_u": d_u, "delta_q": d_q, "k_eps": d_q / d_eps,
        "k_omega_e": k_we, "delta_R": d_R, "delta_omega_e": d_we, "delta_z1": d_q, "delta_z2": d_z2,
        "delta_Psi1": d_psi1, "delta_Psi2": d_psi2, "delta_S1": d_S1, "delta_S2": d_S2, "delta_alpha1": d_alpha1,
        "delta_alpha2": d_alpha2, "delta_Phi": d_omega, "delta_Bu": d_u * B, "c0": c0, "delta_V1": V1,
        "delta_theta1": theta1, "delta_theta2": theta2, "delta_V2": V2, "delta_Q": theta1 + V2**2 / (2 * c0),
        "delta_Qdist": theta1 + (V2 + 0.01) ** 2 / (2 * c0), "margin": c0 / 2 - V1,
    }  # fmt: skip
    assert {name: found[name] for name in by_hand} == pytest.approx(by_hand)


def test_the_verdict_comes_first_the_exit_code_follows_it_and_json_has_every_equation(
    capfd: pytest.CaptureFixture[str],
) -> None:
    overrides = [word for change in [*FREE, *bits(12, 12)] for word in ("--set", change)]
    assert run(("lab", "certify", *overrides, "--set", "wire.rate.limit=0.28")) == 1
    assert capfd.readouterr().out.startswith("The certificate does not hold: range: wire.rate.limit")
    assert run(("lab", "certify", "--json", *overrides)) == 0
    found = json.loads(capfd.readouterr().out)
    assert list(found) == [
        "holds", "pointwise_radius", "pointwise_deg", "plant_radius", "plant_deg", "constant_radius", "delay_ms",
        "lost_frames", "assumptions", "violated", "terms",
    ]  # fmt: skip
    equations = {number for term in found["terms"] for number in term["equation"].replace(",", " ").split()}
    assert {f"C.{n}" for n in range(50, 73)} <= equations
    value = {term["symbol"]: term["value"] for term in found["terms"]}
    assert value["√(δ_Q/k)"] == pytest.approx(sqrt(value["δ_Qdist"] / value["c₀/2 − δ_V1"]))


def test_more_bits_are_never_worse() -> None:
    found = [certify(load_over(PAPER, [*SMALL, *bits(n, n)]), margins=False) for n in (*range(4, 17, 2), None)]
    margins = [each.value("c₀/2 − δ_V1") or -inf for each in found]
    assert margins == sorted(margins)
    sets, means = [each.pointwise_radius for each in found], [each.value("√(δ_Q/k)") for each in found]
    for radii in ([inf if radius is None else radius for radius in each] for each in (sets, means)):
        assert radii == sorted(radii, reverse=True)
        assert radii[-1] < radii[-2] < inf


def test_in_continuous_time_without_quantization_only_the_disturbance_is_left() -> None:
    settings = load_over(PAPER, bits(None, None))
    found, windy = certify(settings), certify(settings, disturbance=0.003)
    assert [found.value(symbol) for symbol in ("δ_V1", "δ_V2", "δ_Qdist")] == [0, 0, 0]  # Remark 7
    assert windy.value("δ_Qdist") == pytest.approx(0.003**2 / (2 * (windy.value("c₀") or 0.0)))  # (C.80)


def test_without_a_set_nothing_is_claimed_of_a_sampled_loop() -> None:
    """At 3 Hz the loop ends in a limit cycle of ‖z‖ 3; √(δ_Q/k) is 0.0145, of continuous time, and says so."""
    found = certify(load_over(PAPER, ["loop.rate_hz=3", *SMALL, *bits(12, 12)]))
    assert found.value("√(δ_Q/k)") is not None
    assert (found.holds, found.pointwise_radius, found.plant_radius, found.constant_radius) == (False, None, None, None)
    assert "continuous time" in {term.symbol: term.meaning for term in found.terms}["√(δ_Q/k)"]


@pytest.mark.parametrize("kind", ["nonadaptive", "pd", "pid"])
def test_other_laws_are_certified_by_the_same_set_and_have_no_paper_s_terms(kind: str) -> None:
    found = certify(certified_settings(12, 12, f"law.kind={kind}"))
    assert found.holds
    assert not {"c₀", "√(δ_Q/k)"} & {term.symbol for term in found.terms}
    assert (found.lost_frames is None) == (kind == "pid")  # an integral does not advance without a measurement
    assert found.constant_radius == found.plant_radius
    if kind == "nonadaptive":
        adaptive = certify(certified_settings(12, 12))
        assert adaptive.constant_radius == found.plant_radius
        assert (found.plant_radius or 9) < (adaptive.plant_radius or 0)


@pytest.mark.parametrize(("out", "inp", "most"), [(12, 12, 0.028), (8, 6, 0.20)])
def test_the_bound_at_every_instant_for_the_paper_s_body(out: int, inp: int, most: float) -> None:
    """At 500 Hz, with the paper's gains and reference, if ‖θ‖ is known to be within that of its first estimate."""
    found = certify(load_over(PAPER, [*SMALL, *bits(out, inp)]))
    assert found.pointwise_radius is not None
    assert found.pointwise_radius <= most
    assert not found.holds  # the Aero's roll is held, its rotors lag
    assert found.plant_radius is None


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (("plant.rotor.lag_up_s=0.154", "plant.rotor.lag_down_s=0.176"), "rotors that lag"),
        (("wire.rate.limit=0.28",), "range: wire.rate.limit"),
        (("wire.voltage.limit=1",), "saturation: wire.voltage.limit"),
        (("plant.rigid_body.damping=[0.02, 0.02, 0.02]",), "law.damping_bound"),
        (("plant.rigid_body.inertia=[0.03, 0.02, 0.02]",), "inertia"),
        (('plant.faults=["attitude:drop=0.1"]',), "plant.faults"),
        (("loop.rate_hz=20",), "ms old"),
        (("plant.rigid_body.allocation=[[0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02]]",), "torque"),
        (("law.C2=[0.03, 0.03, 0.03]",), "no invariant set"),
        (("law.damping_bound=0.05",), "(law.damping_bound)"),
        (("plant.limits.max_tilt_deg=25",), "trip: plant.limits.max_tilt_deg = 25"),
        (("plant.limits.max_tilt_deg=40.9",), "the tilt may reach 41"),  # 40° of the reference, and the set
        (("plant.limits.max_rate=0.05",), "trip: plant.limits.max_rate = 0.05"),
        (("plant.limits.max_rate=0.36",), "‖ω‖ may reach 0.369"),
        (("wire.voltage.limit=2.12", "wire.voltage.bits=6"), "plant.limits.max_saturated_s"),  # as quantized
        (("controller.max_reference_rate=0.3",), "controller.max_reference_rate"),
        (("controller.max_reference_tilt_deg=39",), "controller.max_reference_tilt_deg"),
        (TOO_TILTED, "plant.limits.max_tilt_deg = 75"),
        (TOO_TILTED, "controller.max_reference_tilt_deg = 60"),
    ],
)
def test_everything_that_the_proof_presumes_is_required(change: tuple[str, ...], names: str) -> None:
    """Each of them alone keeps a certificate from holding that holds without."""
    found = certify(certified_settings(12, 12, *change))
    assert (found.holds, found.delay_ms, found.lost_frames) == (False, None, None)
    assert any(names in reason for reason in found.violated), found.violated
    assert found.violated[0] in found.verdict


def test_a_reference_that_rolls_is_not_certified_where_the_roll_is_held() -> None:
    gentle = [*IDEAL, "law.damping_bound=0.0232", "reference.kind=hold", *bits(14, 14)]
    level, rolled = (certify(load_over(PAPER, [*gentle, f"reference.attitude=[{r}, 5, 10]"])) for r in (0, 5))
    assert level.holds
    assert any("rolls" in reason for reason in rolled.violated)


def test_the_assumed_error_is_never_smaller_than_that_of_the_set() -> None:
    found = certify(
        load_over(PAPER, ["law.damping_bound=0.005", "reference.kind=hold", *bits(12, 12)]), disturbance=0.12
    )
    assert (found.pointwise_deg or 0) > 20
    assert degrees(2 * (found.value("max ∡e/2") or 0.0)) == pytest.approx(found.pointwise_deg)


def test_a_machine_holds_only_with_a_stated_disturbance() -> None:
    machine = load_over(PAPER, ["plant.via=quanser", "reference.kind=hold", "law.damping_bound=0.0232", *bits(12, 12)])
    assert any("state --disturbance" in reason for reason in certify(machine).violated)
    assert certify(machine, disturbance=1e-4).holds
    assert any("--disturbance" in assumption for assumption in certify(machine, disturbance=1e-4).assumptions)


def test_c0_is_the_least_share_of_z1_that_the_gain_reaches() -> None:
    """The correction of (C.66), against random errors: z₁ᵀGᵀC₁Gz₁ = ε̃ᵀC₁ε̃ ≥ c₀ ‖z₁‖², and c₀ is all but attained."""
    law = AdaptiveSettings(C1=(0.3, 0.1, 0.2), C2=(9, 9, 9))
    most = radians(100)
    settings = Settings(wire=PAPER.wire.with_bits("cont"), law=law, reference=Hold(attitude=(0.0, 0.0, 0.0)))
    known = known_of(settings, 100)
    c0 = theorem_1(known, lemma_1(known)).c0
    rng = np.random.default_rng(0)
    half, axis = most / 2 * rng.random(20_000), rng.standard_normal((20_000, 3)) * [0.1, 1, 0.1]
    eps = axis / np.linalg.norm(axis, axis=1, keepdims=True) * np.sin(half)[:, None]
    share = (eps**2 @ law.C1) / (2 - 2 * np.cos(half))
    assert share.min() >= c0
    assert share.min() < 1.02 * c0


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("reference.kind=stream", "a stream's set-points are not known beforehand"),
        ("law.kind=sliding", "no theorem for this law, sliding"),
        ("law.allocation=[[1, 0, 0], [0, 1, 1], [0, 1, 1]]", "law.allocation (B) has no inverse"),
    ],
)
def test_of_what_nothing_can_be_certified_one_line_says_why(
    change: str, line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(("lab", "certify", "--set", change)) == 1
    assert capfd.readouterr().err.startswith(f"aeroloop: {line}")


PATIENT = (
    "law.kind=pd", "law.kp=[0.02, 0.02, 0.02]", "law.kd=[0.05, 0.05, 0.05]", "law.damping_bound=0.001",
    "law.damping_estimate=[0, 0.006, 0.006]", "reference.amplitude=[0, 5, 10]",
)  # fmt: skip
"""Gains with which the set alone holds for 160 ms of further delay."""
WAITS_LONG = ("plant.watchdog_s=0.5", "controller.stale_s=0.5", "wire.counter_bits=10")
ON_CHANGE = ("wire.transmit.command=on_change", "wire.transmit.heartbeat_s=0.02")


@pytest.mark.parametrize(
    ("changes", "margins", "patience"),
    [
        ((), (98.0, 49), Patience(0.098, 49, 1)),
        (("plant.watchdog_s=0.05",), (48.0, 24), Patience(0.048, 24, 1)),
        (("controller.stale_s=0.05",), (98.0, 24), Patience(0.098, 24, 1)),
        (("plant.watchdog_s=0.5", "wire.counter_bits=10"), (160.17, 49), Patience(0.498, 49, 1)),
        (ON_CHANGE, (80.0, 4), Patience(0.08, 4, 10)),
        # 80 ticks late are 8 heartbeats: a command lost with its frame is repeated by the next one only.
        ((*ON_CHANGE, *WAITS_LONG), (160.17, 8), Patience(0.48, 24, 10)),
        ((*ON_CHANGE, "loop.lockstep=true"), (98.0, 49), Patience(0.098, 49, 1)),
    ],
)  # fmt: skip
def test_no_margin_is_claimed_beyond_what_the_ends_wait_for(
    changes: tuple[str, ...], margins: tuple[float, int], patience: Patience
) -> None:
    settings = certified_settings(16, 16, *PATIENT, *changes)
    assert patience_of(settings) == pytest.approx(patience)
    found = certify(settings)
    assert (found.delay_ms, found.lost_frames) == pytest.approx(margins, abs=0.02)
    assert certify(settings, late_s=0.001 + margins[0] / 1e3, margins=False).violated


@pytest.mark.parametrize("watchdog_s", [0.1, 0.05, 0.002, 0.0009])
def test_the_plants_own_watchdog_lets_pass_just_what_is_claimed(watchdog_s: float) -> None:
    """`Freshness`, which trips a plant: fresh commands with so many ticks between them that have none."""
    settings = certified_settings(12, 12, f"plant.watchdog_s={watchdog_s}")
    period_ns, patience = settings.loop.period_ns, patience_of(settings)
    assert patience.delay_s == pytest.approx(patience.lost_frames * settings.loop.period)

    def trips(ticks_without: int) -> bool:
        freshness = Freshness(256, period_ns, watchdog_s)
        freshness.measured(0)
        assert freshness.judge(0, 0, 0) is Outcome.ACTED
        overdue = [freshness.overdue(k * period_ns) for k in range(1, ticks_without + 1)]
        return any(reason is not None for reason in overdue)

    assert not trips(patience.lost_frames)
    assert trips(patience.lost_frames + 1)


def test_a_reference_of_points_is_certified_as_it_is_followed() -> None:
    """The paper's body, at rest at 20° and 60° from 4 s on; it used to swing to 99° and 298°."""
    points = Points(times=[0, 4, 50], attitudes=[(0, 0, 0), (0, 20, 60), (0, 20, 60)])
    settings = certified_settings().model_copy(update={"reference": points})
    found = evaluate(settings).plant.desired
    assert degrees(found.pitch) == pytest.approx(20 * 1.005)
    assert degrees(found.tilt) == pytest.approx(20 * 1.005)
    assert certify(settings, margins=False).holds
    swings = settings.model_copy(update={"reference": points.model_copy(update={"interpolation": "differences"})})
    assert any("max_reference_tilt_deg" in reason for reason in certify(swings, margins=False).violated)


def test_at_the_margins_it_holds_and_just_beyond_it_does_not() -> None:
    settings = certified_settings(12, 12)
    found, period = certify(settings), settings.loop.period
    assert found.delay_ms is not None
    assert found.lost_frames is not None
    assert certify(settings, late_s=found.delay_ms / 1e3).holds
    assert certify(settings, late_s=found.lost_frames * period).holds
    assert not certify(settings, late_s=found.delay_ms / 1e3 + 2 * RESOLUTION_S).holds
    assert not certify(settings, late_s=(found.lost_frames + 1) * period).holds
