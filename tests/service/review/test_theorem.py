"""Theorem check of a log: true states at their ticks, premises, inequalities, and the largest ‖z‖."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Truth
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Stream
from aeroloop.service.config import Settings, load
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA, with_checksum
from aeroloop.service.logs.runs import BLOCK
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review import certified_bounds as grounds
from aeroloop.service.review.certified_bounds import certified_bounds
from aeroloop.service.review.observe import Observer
from aeroloop.service.review.report import Findings, Line, TheoremFindings
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read, report
from aeroloop.service.review.theorem_check import TheoremCheck
from aeroloop.service.terminal.log_tables import review_account
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
from aeroloop.service.theorem.lemma import coordinates
from tests.support import numpy_twin as twin
from tests.support.edited_log import Said, rewrite, ticks_of
from tests.support.made_log import SESSION, make_log

TICKS = 600
LEMMA = [f"C.{n}" for n in (26, 27, *range(50, 58))]


def lockstep(*overrides: str) -> Settings:
    return load(overrides=["loop.lockstep=true", *overrides])


def promised(settings: Settings) -> dict[str, Any]:
    """The certificate as the controller's description carries it."""
    return certify(settings).model_dump(mode="json")


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.2 s of the paper's plant, with the true state of every tick."""
    path = tmp_path_factory.mktemp("theorem") / "ideal.mcap"
    make_log(path, TICKS, settings=lockstep("plant.ideal=true"), truth_every=1)
    return path


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 8 s of it, in which the body turns far enough for the attitude to err as much as it can."""
    path = tmp_path_factory.mktemp("theorem") / "long.mcap"
    make_log(path, 4000, settings=lockstep("plant.ideal=true"), truth_every=2)
    return path


def found(path: Path) -> TheoremFindings:
    theorem = read(path).findings.theorem
    assert theorem is not None
    return theorem


def broken(theorem: TheoremFindings) -> dict[str, int]:
    return {check.equation: check.broken for check in theorem.lemma if check.broken}


# The inequalities


def test_on_the_papers_plant_every_inequality_holds_at_every_tick(ideal: Path) -> None:
    theorem = found(ideal)
    saturated = theorem.outside["C.30"]  # the approach asks for more than 24 V
    assert (theorem.samples, theorem.judged) == (TICKS, TICKS - saturated)
    assert 0 < saturated < 50
    assert theorem.outside == {"C.28": 0, "C.29": 0, "C.30": saturated, "Assumption 3": 0}
    counts = [(number, theorem.judged) for number in LEMMA]
    assert [(check.equation, check.samples) for check in theorem.lemma] == counts
    assert (theorem.broken, broken(theorem)) == (0, {})


@pytest.mark.parametrize(
    ("equation", "names"),
    [("C.52", ("delta_z1",)), ("C.53", ("delta_R",)), ("C.55", ("delta_S1", "delta_S2")), ("C.57", ("delta_Phi",))],
)
def test_a_bound_that_is_half_of_what_it_must_be_is_found_broken(
    long: Path, monkeypatch: pytest.MonkeyPatch, equation: str, names: tuple[str, ...]
) -> None:
    def halved(settings: Settings) -> Evaluated:
        bounds = evaluate(settings)
        return replace(bounds, lemma=replace(bounds.lemma, **{name: getattr(bounds.lemma, name) / 2 for name in names}))

    monkeypatch.setattr(grounds, "evaluate", halved)
    findings = read(long).findings
    theorem = findings.theorem
    assert theorem is not None
    assert list(broken(theorem)) == [equation]
    (check,) = (check for check in theorem.lemma if check.broken)
    assert check.closest is not None
    assert check.closest > 1
    assert check.broken_s is not None
    assert check.closest_s is not None
    assert 0 <= check.broken_s <= check.closest_s < 8.0
    why = Limit.parse("lemma_broken=0").broken(findings)
    assert why == f"lemma_broken is {theorem.broken}, more than 0"


def truth_with(one: Said, **changed: Any) -> Said:
    """A truth with these fields changed; any other message unchanged."""
    if one.topic != "truth":
        return one
    return one._replace(data=Truth.model_validate_json(one.data).model_copy(update=changed).encode())


def next_tick(one: Said) -> Said:
    if one.topic != "truth":
        return one
    tick = Truth.model_validate_json(one.data).session_tick
    assert tick is not None
    return truth_with(one, session_tick=tick + 1)


def test_a_true_state_is_compared_with_the_measurement_that_was_taken_of_it(tmp_path: Path) -> None:
    """Where nothing is quantized the two are equal, and those of neighbouring ticks are not."""
    cont = [f"wire.{name}.bits=cont" for name in ("attitude", "rate", "voltage")]
    make_log(tmp_path / "a.mcap", 300, settings=lockstep("plant.ideal=true", *cont), truth_every=1)
    exact = found(tmp_path / "a.mcap")
    assert (exact.outside["C.28"], exact.outside["C.29"]) == (0, 0)
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
    settings = lockstep("plant.ideal=true", "controller.start_within_deg=1", "reference.kind=hold")
    settings = settings.model_copy(update={"wire": settings.wire.with_bits(16, 16)})
    settings = settings.model_copy(update={"reference": Hold(attitude=(0.0, 0.0, 5.0))})
    make_log(tmp_path / "a.mcap", 50, settings=settings, truth_every=1)
    theorem = found(tmp_path / "a.mcap")
    assert theorem.outside["Assumption 3"] == theorem.samples == 50
    assert (theorem.judged, theorem.broken) == (0, None)
    assert "premises" in read(tmp_path / "a.mcap").findings.reasons["theorem.broken"]


def test_what_comes_after_an_operators_change_is_not_judged(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    settings = lockstep("plant.ideal=true")
    make_log(path, TICKS, settings=settings, changes={120: (Gains(C1=(5.0, 5.0, 5.0)), None)}, truth_every=1)
    theorem = found(path)
    assert (theorem.until_s, theorem.samples) == (0.24, 120)
    assert theorem.judged + theorem.outside["C.30"] == 120
    assert broken(theorem) == {}


def test_a_session_is_judged_from_the_end_of_the_approach_in_force_until_the_next_change() -> None:
    operators = Change(session=SESSION, tick=120, gains=Gains(C1=(5.0, 5.0, 5.0)))
    gains = Change(session=SESSION, tick=7, gains=Gains(C1=(0.3, 0.3, 0.3)))
    reference = Change(session=SESSION, tick=40, reference=Hold(), within_s=0.1, here=((0.0, 0.0, 0.0),) * 3)
    found = trial(gains, reference, operators).findings()[0]
    assert (found.since_s, found.until_s) == (0.18, 0.24)
    first = Change(session=SESSION, tick=0, gains=Gains(C1=(0.3, 0.3, 0.3)), reference=Hold())
    assert trial(first, operators).findings()[0].until_s == 0.24
    assert trial(first).findings()[0].until_s is None


def test_a_session_that_begins_far_from_its_reference_is_judged_once_it_is_there() -> None:
    began = Change(session=SESSION, tick=0, gains=Gains(C1=(12.0, 12.0, 12.0)), reference=Hold())
    way = Change(session=SESSION, tick=3, reference=Hold(), within_s=1.0, start=(0.0, 10.0, 60.0))
    operators = Change(session=SESSION, tick=12_000, gains=Gains(C1=(5.0, 5.0, 5.0)))
    one = trial(began, way, operators)
    for k in (502, 503):
        one.truth(k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    one.ticks(block(0, 600))
    found, reasons = one.findings()
    assert (found.since_s, found.until_s, found.samples) == (1.006, 24.0, 1)
    assert found.z_norm is None  # the transient begins then, too
    assert "the transient lasts" in reasons["theorem.z_norm"]
    settled = round((found.since_s + found.transient_s) / 0.002)
    one.ticks(block(settled - 10, 10))
    assert one.findings()[0].z_norm is None
    one.ticks(block(settled, 10))
    assert one.findings()[0].z_norm == 0


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda one: None if one.topic == "truth" else one, "no true state"),
        (lambda one: truth_with(one, session=None, session_tick=None), "no true state"),
        (lambda one: truth_with(one, session="another"), "no true state"),
    ],
    ids=["none", "outside of sessions", "of another session"],
)
def test_without_a_true_state_of_a_tick_nothing_is_judged_and_the_reason_is_reported(
    ideal: Path, tmp_path: Path, change: Callable[[Said], Said | None], why: str
) -> None:
    findings = read(rewrite(ideal, tmp_path / "a.mcap", change)).findings
    assert findings.theorem is not None
    assert (findings.theorem.samples, findings.theorem.broken) == (0, None)
    assert why in findings.reasons["theorem.broken"]
    assert why in Limit.parse("lemma_broken=0").check(findings).found


# Ticks by hand


def block(first: int, count: int) -> Ticks:
    """Ticks at rest, where they shall be."""
    k, zeros, upright = np.arange(first, first + count), np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    one = np.ones(count)
    times = k, k, one, one, one
    state = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))  # θ̂, and the sign
    return Ticks(
        k, *times, upright, upright, zeros, zeros, zeros, zeros, zeros, zeros, np.full((count, 9), 0.3), state, state
    )


def trial(*changes: Change) -> TheoremCheck:
    settings = load(overrides=["reference.kind=hold"])
    one = TheoremCheck(certified_bounds(settings, changes), settings)
    one.changed(changes)
    return one


def test_a_true_state_that_comes_after_its_block_still_counts_and_long_silence_costs_no_memory() -> None:
    late = trial()
    late.ticks(block(0, BLOCK))
    late.truth(BLOCK - 1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    late.ticks(block(BLOCK, BLOCK))
    assert late.findings()[0].samples == 1
    for k in range(3 * BLOCK, 9 * BLOCK):
        late.truth(k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    drawn = late.ticks(block(9 * BLOCK - 10, 10))
    assert late.findings()[0].samples == 11
    late.ticks(block(9 * BLOCK, 10))
    late.truth(9 * BLOCK + 9, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    late.finish()
    assert late.findings()[0].samples == 12
    assert all(np.isfinite(lines).all() for lines in drawn)


def test_the_true_line_goes_from_one_published_state_to_the_next_and_begins_with_the_first() -> None:
    one = trial()
    for k in (10, 30):
        one.truth(k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.001 * k))
    norm = one.ticks(block(0, 40)).norms[:, 1]
    assert np.isnan(norm[:10]).all()
    assert norm[[10, 20, 30, 39]] == pytest.approx([0.01, 0.02, 0.03, 0.03])
    assert one.findings()[0].samples == 2  # what lies between is drawn, not judged
    one.truth(50, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.05))
    assert one.ticks(block(40, 20)).norms[0, 1] == pytest.approx(0.04)


def test_v_has_its_damping_term_where_the_plants_damping_is_known() -> None:
    for plant, V in (("plant.ideal=true", (0.0071**2 + 0.022**2) / 0.02 / 2), ("plant.via=quanser", 0.0)):
        settings = load(overrides=["reference.kind=hold", plant])
        one = TheoremCheck(certified_bounds(settings, ()), settings)
        one.truth(0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        assert float(one.ticks(block(0, 1)).norms[0, 3]) == pytest.approx(V)
        assert one.damping_known == (V > 0)


# What is promised, and what the run did


def quick() -> Settings:
    """Gains with a transient of half a second."""
    gains = [f"law.{name}=[{value}, {value}, {value}]" for name, value in (("C1", 12.0), ("C2", 8.0))]
    small = "reference.amplitude=[0.0, 2.0, 4.0]"
    bits = [f"wire.{name}.bits=16" for name in ("attitude", "rate", "voltage")]
    return lockstep("plant.ideal=true", small, *gains, *bits)


def test_the_largest_norm_and_error_are_those_after_the_transient(tmp_path: Path) -> None:
    settings = quick()
    make_log(tmp_path / "a.mcap", TICKS, settings=settings, truth_every=1)
    blocks: list[Ticks] = []
    judged = read(tmp_path / "a.mcap", watch=blocks.append)
    theorem = judged.findings.theorem
    assert theorem is not None
    assert theorem.transient_s == 0.5
    after = Ticks.joined(blocks).where(slice(250, None))
    norms = []
    for i in range(len(after.k)):
        rate_d = twin.rotation(after.attitude[i]) @ after.desired_rate[i]
        q, omega, q_d, omega_d = (
            np.array([row]) for row in (after.attitude[i], after.rate[i], after.desired[i], rate_d)
        )
        c = coordinates(q, omega, q_d, omega_d, after.state_next[i : i + 1, 3], np.array(with_theorem(settings).law.C1))
        norms.append(float(c.norm[0]))
    assert theorem.z_norm == pytest.approx(max(norms), rel=1e-9)
    largest = np.linalg.norm(after.attitude_error, axis=1).max()
    assert theorem.error_deg == pytest.approx(np.degrees(2 * np.arcsin(largest)))
    # Of 16 bits, what is measured is what is true to some 1e-4.
    assert theorem.true_z_norm == pytest.approx(theorem.z_norm, abs=1e-3)
    assert theorem.true_error_deg == pytest.approx(theorem.error_deg, abs=1e-2)


def test_before_the_transient_is_over_there_is_no_largest_norm_and_the_reason_is_reported(ideal: Path) -> None:
    findings = read(ideal).findings
    assert findings.theorem is not None
    assert (findings.theorem.transient_s, findings.theorem.z_norm) == (20.0, None)
    assert "the transient lasts 20 s, and the session ended before" in findings.reasons["theorem.z_norm"]
    assert Limit.parse("z_norm=1").broken(findings) == "z_norm is not known, so it is not at most 1"


def with_description(path: Path, out: Path, certificate: dict[str, Any]) -> Path:
    """The log with a certificate in its controller's description."""
    config = read(path).session.settings.description()
    description = Description(
        protocol=PROTOCOL_VERSION,
        role="controller",
        vehicle="aero",
        host="h",
        versions={},
        config=config,
        certificate=certificate,
    )
    entry = {"key": "aeroloop/aero/description/controller", "json": description.model_dump_json()}
    return rewrite(path, out, metadata=[(DESCRIPTION_METADATA, with_checksum(DESCRIPTION_METADATA, entry))])


def test_the_contracts_certificate_is_what_counts_unless_the_session_began_with_other_gains(
    ideal: Path, tmp_path: Path
) -> None:
    promise = {**promised(lockstep("plant.ideal=true")), "violated": [], "holds": True, "plant_deg": 40.0}
    half = {**promise, "plant_radius": 0.5}
    assert found(with_description(ideal, tmp_path / "a.mcap", half)).pointwise_radius == 0.5
    assert certified_bounds(lockstep(), (), half).pointwise_radius == 0.5
    other = Change(session=SESSION, tick=0, gains=Gains(C1=(0.4, 0.3, 0.3)), reference=lockstep().reference)
    assert certified_bounds(lockstep(), [other], half).pointwise_radius is None


def test_of_a_stream_and_of_gains_that_fail_nothing_is_guaranteed() -> None:
    stream = Change(session=SESSION, tick=0, reference=Stream())
    found, reasons = trial(stream).findings()
    assert (found.holds, found.held, found.radius, found.pointwise_radius) == (None, None, None, None)
    names = ("radius", "pointwise_radius", "mean_square_share", "pointwise_share", "broken", "held")
    assert all("stream" in reasons[f"theorem.{name}"] for name in names)
    failing = Change(session=SESSION, tick=0, gains=Gains(C1=(3.0, 3.0, 3.0)), reference=load().reference)
    one = trial(failing)
    one.truth(0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    one.ticks(block(0, 1))
    found, reasons = one.findings()
    assert (found.holds, found.radius, found.pointwise_deg) == (False, None, None)
    assert "V need not decrease" in reasons["theorem.mean_square_share"]
    assert reasons["theorem.pointwise_radius"] == "the certificate does not hold"


# What is shown


def line(path: Path, group: str, label: str) -> Line:
    (panel,) = (panel for panel in report([path]).panels if panel.group == group)
    (line,) = (line for line in panel.lines if line.label == label)
    return line


def test_the_norm_is_drawn_and_v_falls_along_the_run(ideal: Path) -> None:
    measured, true = line(ideal, "z_norm", "measured").values, line(ideal, "z_norm", "true").values
    assert np.abs(measured - true).max() < 0.05
    V = line(ideal, "lyapunov", "true, with θ̃").values
    assert V[-1] < V[0]
    assert line(ideal, "lyapunov", "measured, without θ̃").values[-1] < V[-1]


def test_the_bound_is_drawn_after_the_transient_and_until_gains_or_reference_change() -> None:
    first = Change(session=SESSION, tick=0, gains=Gains(), reference=Hold())
    settings = load(overrides=["reference.kind=hold"])
    holds = {**promised(settings), "violated": [], "holds": True, "plant_radius": 0.5, "plant_deg": 40.0}
    check = TheoremCheck(certified_bounds(settings, (), holds), settings)
    check.changed([first, first.model_copy(update={"tick": 16_000})])
    settled_s, changed_s = check.judged_s
    observer = Observer(settings, check)
    observer.ticks(Ticks.joined([ticks_of(k) for k in range(0, 20_000, 100)]))
    time, panels = observer.lines()
    (level,) = (line for panel in panels if panel.group == "z_norm" for line in panel.lines if line.desired)
    assert changed_s == 32.0
    assert 0 < settled_s < 32.0
    np.testing.assert_array_equal(level.values, np.where((time >= settled_s) & (time < 32.0), 0.5, np.nan))


def test_without_a_bound_at_every_instant_that_of_the_mean_square_is_drawn_by_its_name() -> None:
    settings = lockstep("plant.ideal=true", "reference.kind=hold", "law.damping_bound=0.0232")
    check = TheoremCheck(certified_bounds(settings, ()), settings)
    observer = Observer(settings, check)
    for k in (10_001, 10_002):
        check.truth(k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    observer.ticks(block(10_000, 10))
    (panel,) = (panel for panel in observer.lines()[1] if panel.group == "z_norm")
    assert check.radius is not None
    levels = {line.label: set(line.values) for line in panel.lines if line.desired}
    assert levels == {"bound of the root mean square": {check.radius}}


def test_the_account_and_the_json_say_what_held(ideal: Path, capfd: pytest.CaptureFixture[str]) -> None:
    findings = read(ideal).findings
    review_account(findings)
    said = " ".join(capfd.readouterr().out.split())
    assert "The certificate does not hold" in said
    assert "this run ✓ kept to Lemma 1, the mean square" in said
    assert re.search(r"mean square ∫k‖z‖² is at most [\d.]+ % of V\(t₀\) \+ ∫δ_Q", said)
    assert "every instant — (no invariant set is proven of the configured plant)" in said
    assert re.search(r"holds at the 5\d\d of 600 true states that satisfy its premises", said)
    again = Findings.model_validate(json.loads(findings.model_dump_json()))
    assert again.theorem == findings.theorem
    assert findings.theorem is not None
    keys = {"equation", "what", "samples", "broken", "closest", "closest_s", "broken_s"}
    assert findings.theorem.lemma[0].model_dump().keys() == keys
