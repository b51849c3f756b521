"""Theorem check of a log: true states at their ticks, premises, inequalities, and what is proven at any length."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Truth
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Sinusoid, Stream
from aeroloop.service.config import Settings, load
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review import theorem as check
from aeroloop.service.review.events import Truths, judged_ticks
from aeroloop.service.review.panels import panels_of
from aeroloop.service.review.report import Check, TheoremFindings
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read
from aeroloop.service.review.theorem import TheoremCheck, check_theorem
from aeroloop.service.terminal.log_tables import review_account
from aeroloop.service.theorem import any_law
from aeroloop.service.theorem.any_law import promise
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
from aeroloop.service.theorem.invariant import Premises, Reach, reach
from aeroloop.service.theorem.lemma import coordinates
from aeroloop.service.theorem.mean_square import Decay, decay
from tests.support import numpy_twin as twin
from tests.support.edited_log import Said, at_rest, message_of, rewrite
from tests.support.made_log import SESSION, START_NS, Changes, make_log

TICKS = 600
LEMMA = [f"C.{n}" for n in (26, 27, *range(50, 58))]
IDEAL_AERO = (
    "plant.rotor.lag_up_s=0", "plant.rotor.lag_down_s=0", "plant.rotor.dead_zone_v=0", "plant.friction.viscous=[]",
    "plant.friction.coulomb=[]", "plant.sensors.attitude=perfect", "plant.sensors.rate=perfect",
    "plant.aero.centre_of_mass=[0, 0, -0.0038]",
)  # fmt: skip
"""An Aero of the paper's equations alone, whose damping can be set."""
CERTIFIED = (
    "plant.kind=rigid_body", "plant.ideal=true", "plant.rigid_body.damping=[0.006, 0.005, 0.007]", "wire.actuators=3",
    "law.damping_bound=0.0119", "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]",
    "law.centre_of_mass=[0, 0, 0]",
)  # fmt: skip
"""A free body for which the certificate holds at 12 bits."""


def lockstep(*overrides: str, bits: int | None = None) -> Settings:
    signals = [f"wire.{name}.bits={bits}" for name in ("attitude", "rate", "voltage")] if bits else []
    return load(overrides=["loop.lockstep=true", *signals, *overrides])


Logs = Callable[[str], Path]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Logs:
    """Logs that several tests read, by name, each made once."""
    folder = tmp_path_factory.mktemp("theorem")
    reference = lockstep().reference
    assert isinstance(reference, Sinusoid)
    rate = [radians(a) * f for a, f in zip(reference.amplitude, reference.frequency, strict=True)]
    begins = f"plant.rigid_body.rate={rate}", "law.damping_estimate=[0.006, 0.005, 0.007]"
    known: dict[str, tuple[int, int, Settings]] = {
        # The paper's plant for 1.2 s, with every true state; and for 8 s, in which the attitude errs most.
        "ideal": (TICKS, 1, lockstep("plant.ideal=true")),
        "long": (4000, 2, lockstep("plant.ideal=true")),
        # A certified body that begins at rest while its reference moves; and one with the reference's rate and θ̂ = θ.
        "certified": (1500, 1, lockstep(*CERTIFIED, bits=12)),
        "settled": (300, 1, lockstep(*CERTIFIED, *begins, bits=12)),
    }

    def log(name: str) -> Path:
        path, (ticks, every, settings) = folder / f"{name}.mcap", known[name]
        if not path.exists():
            make_log(path, ticks, settings=settings, truth_every=every)
        return path

    return log


def found(path: Path) -> TheoremFindings:
    theorem = read(path).findings.theorem
    assert theorem is not None
    return theorem


def broken(theorem: TheoremFindings) -> dict[str, int]:
    return {one.equation: one.broken for one in theorem.lemma if one.broken}


# The inequalities


def test_on_the_papers_plant_every_inequality_holds_at_every_tick(logs: Logs) -> None:
    theorem = found(logs("ideal"))
    saturated = theorem.outside["C.30"]  # the approach asks for more than 24 V
    assert (theorem.samples, theorem.judged) == (TICKS, TICKS - saturated)
    assert 0 < saturated < 50
    assert theorem.outside == {"C.28": 0, "C.29": 0, "C.30": saturated, "Assumption 3": 0}
    assert [(one.equation, one.samples) for one in theorem.lemma] == [(number, theorem.judged) for number in LEMMA]
    assert (theorem.broken, broken(theorem), theorem.z_norm) == (0, {}, None)
    reasons = read(logs("ideal")).findings.reasons
    assert "the transient lasts 20 s, and the session ended before" in reasons["theorem.z_norm"]


@pytest.mark.parametrize(
    ("equation", "names"),
    [("C.52", ("delta_z1",)), ("C.53", ("delta_R",)), ("C.55", ("delta_S1", "delta_S2")), ("C.57", ("delta_Phi",))],
)
def test_a_bound_that_is_half_of_what_it_must_be_is_found_broken(
    logs: Logs, monkeypatch: pytest.MonkeyPatch, equation: str, names: tuple[str, ...]
) -> None:
    def halved(settings: Settings) -> Evaluated:
        e = evaluate(settings)
        return replace(e, lemma=replace(e.lemma, **{name: getattr(e.lemma, name) / 2 for name in names}))

    monkeypatch.setattr(any_law, "evaluate", halved)
    findings = read(logs("long")).findings
    theorem = findings.theorem
    assert theorem is not None
    assert list(broken(theorem)) == [equation]
    (one,) = (one for one in theorem.lemma if one.broken)
    assert one.closest is not None
    assert one.closest > 1
    assert one.broken_s is not None
    assert one.closest_s is not None
    assert 0 <= one.broken_s <= one.closest_s < 8.0
    assert not Limit.parse("lemma_broken=0").holds(findings)
    assert theorem.held is False


def truth_with(one: Said, **changed: Any) -> Said:
    """A truth with these fields changed; any other message unchanged."""
    if one.topic != "truth":
        return one
    return one._replace(data=Truth.model_validate_json(one.data).model_copy(update=changed).encode())


def tick_of(one: Said) -> int:
    tick = Truth.model_validate_json(one.data).session_tick
    assert tick is not None
    return tick


def test_a_true_state_is_compared_with_the_measurement_that_was_taken_of_it(tmp_path: Path) -> None:
    """Where nothing is quantized the two are equal, and those of neighbouring ticks are not."""
    cont = [f"wire.{name}.bits=cont" for name in ("attitude", "rate", "voltage")]
    make_log(tmp_path / "a.mcap", 300, settings=lockstep("plant.ideal=true", *cont), truth_every=1)
    exact = found(tmp_path / "a.mcap")
    assert (exact.outside["C.28"], exact.outside["C.29"]) == (0, 0)

    def next_tick(one: Said) -> Said:
        return one if one.topic != "truth" else truth_with(one, session_tick=tick_of(one) + 1)

    late = found(rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", next_tick))
    assert late.outside["C.29"] > 250


def test_where_sensors_err_more_than_quantizers_the_lemma_is_judged_by_the_rest(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=lockstep(), truth_every=2)
    theorem = found(tmp_path / "a.mcap")
    assert theorem.samples == TICKS // 2
    assert theorem.outside["C.29"] > 0
    assert theorem.samples - theorem.outside["C.29"] - theorem.outside["C.30"] <= theorem.judged < theorem.samples
    assert theorem.broken == 0


def test_an_error_larger_than_the_certificate_assumes_is_not_judged(tmp_path: Path) -> None:
    """A session that begins 5° from its reference, with a certificate that assumes 1°."""
    settings = lockstep("plant.ideal=true", "controller.start_within_deg=1", "reference.kind=hold", bits=16)
    settings = settings.model_copy(update={"reference": Hold(attitude=(0.0, 0.0, 5.0))})
    make_log(tmp_path / "a.mcap", 50, settings=settings, truth_every=1)
    findings = read(tmp_path / "a.mcap").findings
    theorem = findings.theorem
    assert theorem is not None
    assert theorem.outside["Assumption 3"] == theorem.samples == 50
    assert (theorem.judged, theorem.broken) == (0, None)
    assert "premises" in findings.reasons["theorem.broken"]


@pytest.mark.parametrize(
    "change",
    [
        lambda one: None if one.topic == "truth" else one,
        lambda one: truth_with(one, session=None, session_tick=None),
        lambda one: truth_with(one, session="another"),
    ],
    ids=["none", "outside of sessions", "of another session"],
)
def test_without_a_true_state_of_a_tick_nothing_is_judged_and_the_reason_is_reported(
    logs: Logs, tmp_path: Path, change: Callable[[Said], Said | None]
) -> None:
    findings = read(rewrite(logs("ideal"), tmp_path / "a.mcap", change)).findings
    assert findings.theorem is not None
    assert (findings.theorem.samples, findings.theorem.broken) == (0, None)
    assert "no true state" in findings.reasons["theorem.broken"]
    assert "no true state" in Limit.parse("lemma_broken=0").check(findings).found


# What is judged at any length


@pytest.mark.parametrize(
    ("overrides", "bits"),
    [
        ((*IDEAL_AERO, "plant.aero.damping=[0, 0.03, 0.04]"), 16),
        (("plant.ideal=true", "law.damping_estimate=[0, 0.03, -0.03]"), 14),
        (("plant.ideal=true", "law.damping_estimate=[0.02, -0.04, 0]"), 12),
    ],
    ids=["damping at its bound", "an estimate of the wrong sign", "an estimate at its bound"],
)
def test_a_run_that_satisfies_every_premise_keeps_to_what_is_proven_long_before_the_estimate_settles(
    tmp_path: Path, overrides: tuple[str, ...], bits: int
) -> None:
    make_log(tmp_path / "a.mcap", 1500, settings=lockstep(*overrides, bits=bits), truth_every=1)
    findings = read(tmp_path / "a.mcap").findings
    theorem = findings.theorem
    assert theorem is not None
    assert theorem.samples - theorem.outside["C.30"] == theorem.judged > 1400
    assert theorem.mean_square_judged > 1400
    assert (theorem.held, theorem.broken) == (True, 0)
    assert Limit.parse("theorem=1").holds(findings)


def test_a_certified_body_stays_within_the_set_that_it_entered(logs: Logs) -> None:
    theorem = found(logs("certified"))
    assert (theorem.holds, theorem.held, theorem.broken, theorem.outside["C.30"]) == (True, True, 0, 0)
    assert theorem.mean_square_judged == 1499
    assert theorem.pointwise_judged > 1000
    assert theorem.pointwise_bound is not None
    assert theorem.pointwise_radius is not None
    assert 1 < theorem.pointwise_bound / theorem.pointwise_radius < 1.1
    assert theorem.pointwise_share is not None
    assert 0.1 < theorem.pointwise_share < 1
    assert theorem.spacing_s == pytest.approx(0.002)


def larger_k(e: Evaluated, seen: float) -> Decay | None:
    found = decay(e, seen)
    return found and found._replace(k=100 * found.k)


def no_delta(e: Evaluated, seen: float) -> Decay | None:
    found = decay(e, seen)
    return found and found._replace(delta=0.0)


def small_set(p: Premises, start: float = 0.0) -> Reach | None:
    found = reach(p, start)
    return found and replace(found, radius=found.radius / 3)


@pytest.mark.parametrize(
    ("log", "name", "false", "not_kept"),
    [
        ("certified", "decay", larger_k, "mean square"),
        ("settled", "decay", no_delta, "mean square"),
        ("certified", "reach", small_set, "pointwise"),
    ],
    ids=["k", "delta", "radius"],
)
def test_a_statement_that_is_falsified_is_found_broken(
    logs: Logs, monkeypatch: pytest.MonkeyPatch, log: str, name: str, false: Callable[..., Any], not_kept: str
) -> None:
    assert found(logs(log)).held is True
    monkeypatch.setattr(check, name, false)
    findings = read(logs(log)).findings
    theorem = findings.theorem
    assert theorem is not None
    shares = {"mean square": theorem.mean_square_share, "pointwise": theorem.pointwise_share}
    assert {name for name, share in shares.items() if share is not None and share > 1} == {not_kept}
    assert (theorem.held, theorem.broken) == (False, 0)
    assert Limit.parse("theorem=1").check(findings) == Check(text="theorem ≥ 1", holds=False, found="0")


def test_a_gap_in_true_states_or_a_lost_frame_begins_a_new_piece(logs: Logs, tmp_path: Path) -> None:
    def without(one: Said) -> Said | None:
        return None if one.topic == "truth" and 600 < tick_of(one) < 750 else one  # 0.3 s; 10 Hz are 0.1 s apart

    theorem = found(rewrite(logs("certified"), tmp_path / "a.mcap", without))
    assert theorem.mean_square_judged == 1499 - 149 - 1
    assert theorem.spacing_s == pytest.approx(0.002)
    make_log(tmp_path / "b.mcap", 300, settings=lockstep(*CERTIFIED, bits=12), truth_every=10, lost=[205])
    theorem = found(tmp_path / "b.mcap")
    assert (theorem.samples, theorem.outside["C.30"], theorem.held) == (30, 0, True)
    assert theorem.mean_square_judged == 29 - 1
    assert theorem.spacing_s == pytest.approx(0.02)


def test_with_faults_at_the_plant_only_the_lemma_is_judged(tmp_path: Path) -> None:
    settings, injected = lockstep(*CERTIFIED, bits=12), {100: "motor1:bias=0.5"}
    make_log(tmp_path / "a.mcap", 300, settings=settings, truth_every=1, injected=injected)
    findings = read(tmp_path / "a.mcap").findings
    assert findings.theorem is not None
    assert (findings.theorem.mean_square_share, findings.theorem.pointwise_share) == (None, None)
    assert findings.reasons["theorem.mean_square_share"] == "faults acted at the plant"
    assert findings.theorem.held is True


# From when until when


def change(tick: int, **parts: Any) -> Change:
    return Change(session=SESSION, tick=tick, **parts)


def test_what_comes_after_an_operators_change_is_not_judged(tmp_path: Path) -> None:
    changes: Changes = {120: (Gains(C1=(5.0, 5.0, 5.0)), None)}
    make_log(tmp_path / "a.mcap", TICKS, settings=lockstep("plant.ideal=true"), changes=changes, truth_every=1)
    theorem = found(tmp_path / "a.mcap")
    assert (theorem.until_s, theorem.samples) == (0.24, 120)
    assert theorem.judged + theorem.outside["C.30"] == 120
    assert broken(theorem) == {}


@pytest.mark.parametrize(
    ("changes", "span"),
    [
        ([change(7, gains=Gains()), change(40, reference=Hold(), within_s=0.1), change(120, gains=Gains())], (90, 120)),
        ([change(0, gains=Gains(), reference=Hold()), change(120, gains=Gains())], (0, 120)),
        ([change(0, gains=Gains(), reference=Hold())], (0, np.inf)),
        # An approach from where the body was found, which takes a second.
        (
            [
                change(0, gains=Gains(), reference=Hold()),
                change(3, reference=Hold(), within_s=1.0, start=(0.0, 10.0, 60.0)),
                change(12_000, gains=Gains()),
            ],
            (503, 12_000),
        ),
    ],
)
def test_a_session_is_judged_from_the_end_of_its_approach_until_the_next_change(
    changes: list[Change], span: tuple[int, float]
) -> None:
    assert judged_ticks(changes, 0.002) == span


def truths_at(*ticks: int, rates: tuple[float, ...] = ()) -> Truths:
    """True states that do not turn, but about z at these rates."""
    still, k = np.zeros((len(ticks), 3)), np.array(ticks, dtype=np.int64)
    still[: len(rates), 2] = rates
    return Truths(k, np.tile([1.0, 0.0, 0.0, 0.0], (len(k), 1)), still)


def trial(ticks: Ticks, truths: Truths, *changes: Change, plant: str = "plant.ideal=false") -> TheoremCheck:
    return check_theorem(load(overrides=["reference.kind=hold", plant]), ticks, truths, changes)


def test_the_largest_norm_is_known_once_the_transient_after_the_approach_is_over() -> None:
    began = change(0, gains=Gains(C1=(12.0, 12.0, 12.0)), reference=Hold())
    way = change(3, reference=Hold(), within_s=1.0, start=(0.0, 10.0, 60.0))
    early = trial(at_rest(range(600)), truths_at(502, 503), began, way)
    assert (early.findings.since_s, early.findings.samples, early.findings.z_norm) == (1.006, 1, None)
    assert "the transient lasts" in early.reasons["theorem.z_norm"]
    settled = round((early.findings.since_s + early.findings.transient_s) / 0.002)
    assert trial(at_rest(range(settled)), truths_at(), began, way).findings.z_norm is None
    assert trial(at_rest(range(settled + 1)), truths_at(), began, way).findings.z_norm == 0


def test_the_true_line_goes_from_one_published_state_to_the_next_and_begins_with_the_first() -> None:
    settings, ticks = load(overrides=["reference.kind=hold"]), at_rest(range(40))
    found = check_theorem(settings, ticks, truths_at(10, 30, 90, rates=(0.01, 0.03, 0.09)))
    assert found.findings.samples == 2  # what lies between is drawn, not judged
    lines = {
        (panel.group, line.label): line.values for panel in panels_of(settings, ticks, found)[1] for line in panel.lines
    }
    norm = lines["z_norm", "true"]
    assert np.isnan(norm[:10]).all()
    assert norm[[10, 20, 30, 39]] == pytest.approx([0.01, 0.02, 0.03, 0.03])


def test_v_has_its_damping_term_where_the_plants_damping_is_known() -> None:
    for plant, V in (("plant.ideal=true", (0.0071**2 + 0.022**2) / 0.02 / 2), ("plant.via=quanser", 0.0)):
        found = trial(at_rest([0]), truths_at(0), plant=plant)
        assert float(found.true[1, 0]) == pytest.approx(V)
        assert found.findings.damping_known == (V > 0)


# What is promised, and what the run did


def quick() -> Settings:
    """Gains with a transient of half a second."""
    gains = [f"law.{name}=[{value}, {value}, {value}]" for name, value in (("C1", 12.0), ("C2", 8.0))]
    return lockstep("plant.ideal=true", "reference.amplitude=[0.0, 2.0, 4.0]", *gains, bits=16)


def test_the_largest_norm_and_error_are_those_after_the_transient(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=quick(), truth_every=1)
    judged = read(tmp_path / "a.mcap")
    theorem, after = judged.findings.theorem, judged.ticks.where(slice(250, None))
    assert theorem is not None
    assert theorem.transient_s == 0.5
    norms = []
    for i in range(len(after.k)):
        rate_d = twin.rotation(after.attitude[i]) @ after.desired_rate[i]
        q, omega, q_d, omega_d = (
            np.array([row]) for row in (after.attitude[i], after.rate[i], after.desired[i], rate_d)
        )
        c = coordinates(q, omega, q_d, omega_d, after.state_next[i : i + 1, 3], np.array(with_theorem(quick()).law.C1))
        norms.append(float(c.norm[0]))
    assert theorem.z_norm == pytest.approx(max(norms), rel=1e-9)
    largest = np.linalg.norm(after.attitude_error, axis=1).max()
    assert theorem.error_deg == pytest.approx(np.degrees(2 * np.arcsin(largest)))
    # Of 16 bits, what is measured is what is true to some 1e-4.
    assert theorem.true_z_norm == pytest.approx(theorem.z_norm, abs=1e-3)
    assert theorem.true_error_deg == pytest.approx(theorem.error_deg, abs=1e-2)


def held(settings: Settings, **values: float) -> dict[str, Any]:
    """A certificate that holds, as the controller's description carries it."""
    return {**certify(settings).model_dump(mode="json"), "violated": [], "holds": True, "plant_deg": 40.0, **values}


def test_the_descriptions_certificate_is_what_counts_unless_the_session_began_with_other_gains(
    logs: Logs, tmp_path: Path
) -> None:
    half = held(lockstep("plant.ideal=true"), plant_radius=0.5)
    config = lockstep("plant.ideal=true").description()
    description = Description(
        protocol=PROTOCOL_VERSION, role="controller", vehicle="aero", host="h", versions={}, config=config,
        certificate=half,
    )  # fmt: skip
    more = [message_of("description", description, START_NS - 10**9)]
    assert found(rewrite(logs("ideal"), tmp_path / "a.mcap", more=more)).pointwise_radius == 0.5
    other = change(0, gains=Gains(C1=(0.4, 0.3, 0.3)), reference=lockstep().reference)
    holds = [promise(lockstep("plant.ideal=true"), changes, half).certificate for changes in ([], [other])]
    assert [one is not None and one.holds for one in holds] == [True, False]


def test_of_a_stream_and_of_gains_that_fail_nothing_is_guaranteed() -> None:
    stream = trial(at_rest([0]), truths_at(), change(0, reference=Stream()))
    nothing = stream.findings
    assert (nothing.holds, nothing.held, nothing.radius, nothing.pointwise_radius) == (None, None, None, None)
    names = ("radius", "pointwise_radius", "mean_square_share", "pointwise_share", "broken", "held")
    assert all("stream" in stream.reasons[f"theorem.{name}"] for name in names)
    failing = change(0, gains=Gains(C1=(3.0, 3.0, 3.0)), reference=load().reference)
    failed = trial(at_rest([0]), truths_at(0), failing)
    assert (failed.findings.holds, failed.findings.radius, failed.findings.pointwise_deg) == (False, None, None)
    assert "V need not decrease" in failed.reasons["theorem.mean_square_share"]
    assert failed.reasons["theorem.pointwise_radius"] == "the certificate does not hold"


# What is shown


def test_the_norm_is_drawn_and_v_falls_along_the_run(logs: Logs) -> None:
    panels = read(logs("ideal")).report().panels
    lines = {(panel.group, line.label): line.values for panel in panels for line in panel.lines}
    assert np.abs(lines["z_norm", "measured"] - lines["z_norm", "true"]).max() < 0.05
    for name in ("true, with θ̃", "measured, without θ̃"):
        assert lines["lyapunov", name][-1] < lines["lyapunov", name][0]


def test_the_bound_is_drawn_after_the_transient_and_until_gains_or_reference_change() -> None:
    settings, first = load(overrides=["reference.kind=hold"]), change(0, gains=Gains(), reference=Hold())
    changes, ticks = [first, change(16_000, gains=Gains(), reference=Hold())], at_rest(range(0, 20_000, 100))
    found = check_theorem(settings, ticks, truths_at(), changes, held(settings, plant_radius=0.5))
    time, panels, _ = panels_of(settings, ticks, found)
    (level,) = (line for panel in panels if panel.group == "z_norm" for line in panel.lines if line.desired)
    settled_s = found.findings.since_s + found.findings.transient_s
    assert 0 < settled_s < 32.0
    assert level.label == "bound, once within it"
    np.testing.assert_array_equal(level.values, np.where((time >= settled_s) & (time < 32.0), 0.5, np.nan))


def test_without_a_bound_at_every_instant_that_of_the_mean_square_is_drawn_by_its_name() -> None:
    settings = lockstep("plant.ideal=true", "reference.kind=hold", "law.damping_bound=0.0232")
    ticks = at_rest(range(10_000, 10_010))
    found = check_theorem(settings, ticks, truths_at(10_001, 10_002))
    (panel,) = (panel for panel in panels_of(settings, ticks, found)[1] if panel.group == "z_norm")
    levels = {line.label: set(line.values) for line in panel.lines if line.desired}
    assert found.findings.radius is not None
    assert levels == {"bound of the root mean square": {found.findings.radius}}


def test_the_account_says_what_held(logs: Logs, capfd: pytest.CaptureFixture[str]) -> None:
    findings = read(logs("ideal")).findings
    review_account(findings)
    said = " ".join(capfd.readouterr().out.split())
    assert "The certificate does not hold" in said
    assert "The run kept to Lemma 1, the mean square." in said
    assert re.search(r"∫k‖z‖² is at most [\d.]+ % of V\(t₀\) \+ ∫δ_Q", said)
    assert "Not judged, since no invariant set is proven of the configured plant: true ‖z‖ of its bound" in said
    assert re.search(r"600 true states belong to a tick\. At \d\d .*Lemma 1 is judged by the other 5\d\d\.", said)
