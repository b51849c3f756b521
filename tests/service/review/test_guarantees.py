"""What is judged at any length: the mean square of ‖z‖, and the invariant set once entered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import radians
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.service.config import Settings, load
from aeroloop.service.review import certified_bounds as grounds
from aeroloop.service.review import guarantees
from aeroloop.service.review.report import Findings
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
from aeroloop.service.theorem.invariant import Premises, Reach, reach
from aeroloop.service.theorem.mean_square import Decay, decay
from tests.support.edited_log import Said, rewrite
from tests.support.made_log import make_log

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


def settings(*overrides: str, bits: int) -> Settings:
    signals = [f"wire.{name}.bits={bits}" for name in ("attitude", "rate", "voltage")]
    return load(overrides=["loop.lockstep=true", *signals, *overrides])


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3 s of the certified body, which begins at rest: the reference moves at once."""
    path = tmp_path_factory.mktemp("guarantees") / "certified.mcap"
    make_log(path, 1500, settings=settings(*CERTIFIED, bits=12), truth_every=1)
    return path


@pytest.fixture(scope="module")
def settled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """0.6 s of it, begun with the reference's rate and with θ̂ = θ: V(t₀) is small."""
    path = tmp_path_factory.mktemp("guarantees") / "settled.mcap"
    reference = settings(bits=12).reference
    assert isinstance(reference, Sinusoid)
    rate = [radians(a) * f for a, f in zip(reference.amplitude, reference.frequency, strict=True)]
    begins = f"plant.rigid_body.rate={rate}", "law.damping_estimate=[0.006, 0.005, 0.007]"
    make_log(path, 300, settings=settings(*CERTIFIED, *begins, bits=12), truth_every=1)
    return path


def broken(findings: Findings) -> set[str]:
    """Which statements the run does not keep to."""
    theorem = findings.theorem
    assert theorem is not None
    shares = {"mean square": theorem.mean_square_share, "pointwise": theorem.pointwise_share}
    names = {name for name, share in shares.items() if share is not None and share > 1}
    return names | ({"lemma"} if theorem.broken else set())


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
    make_log(tmp_path / "a.mcap", 1500, settings=settings(*overrides, bits=bits), truth_every=1)
    findings = read(tmp_path / "a.mcap").findings
    theorem = findings.theorem
    assert theorem is not None
    assert theorem.samples - theorem.outside["C.30"] == theorem.judged > 1400
    assert theorem.mean_square_judged > 1400
    assert (theorem.held, broken(findings)) == (True, set())
    assert Limit.parse("theorem=1").broken(findings) is None


def test_a_certified_body_stays_within_the_set_that_it_entered(certified: Path) -> None:
    findings = read(certified).findings
    theorem = findings.theorem
    assert theorem is not None
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


def small_lemma(one: Settings) -> Evaluated:
    e = evaluate(one)
    return replace(e, lemma=replace(e.lemma, delta_R=e.lemma.delta_R / 3))


@pytest.mark.parametrize(
    ("log", "where", "name", "false", "found"),
    [
        ("certified", guarantees, "decay", larger_k, "mean square"),
        ("settled", guarantees, "decay", no_delta, "mean square"),
        ("certified", guarantees, "reach", small_set, "pointwise"),
        ("certified", grounds, "evaluate", small_lemma, "lemma"),
    ],
    ids=["k", "delta", "radius", "lemma"],
)
def test_a_bound_that_is_falsified_is_found_broken(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    log: str,
    where: ModuleType,
    name: str,
    false: Callable[..., Any],
    found: str,
) -> None:
    path = request.getfixturevalue(log)
    assert Limit.parse("theorem=1").broken(read(path).findings) is None
    monkeypatch.setattr(where, name, false)
    findings = read(path).findings
    assert findings.theorem is not None
    assert broken(findings) == {found}
    assert findings.theorem.held is False
    assert Limit.parse("theorem=1").broken(findings) == "theorem is 0, less than 1"


def test_a_gap_in_true_states_or_a_lost_frame_begins_a_new_piece(certified: Path, tmp_path: Path) -> None:
    def without(one: Said) -> Said | None:
        if one.topic != "truth":
            return one
        tick = Truth.model_validate_json(one.data).session_tick
        assert tick is not None
        return None if 600 < tick < 750 else one  # 0.3 s; the configured 10 Hz are 0.1 s apart

    theorem = read(rewrite(certified, tmp_path / "a.mcap", without)).findings.theorem
    assert theorem is not None
    assert theorem.mean_square_judged == 1499 - 149 - 1
    assert theorem.spacing_s == pytest.approx(0.002)
    make_log(tmp_path / "b.mcap", 300, settings=settings(*CERTIFIED, bits=12), truth_every=10, lost=[205])
    theorem = read(tmp_path / "b.mcap").findings.theorem
    assert theorem is not None
    assert (theorem.samples, theorem.outside["C.30"], theorem.held) == (30, 0, True)
    assert theorem.mean_square_judged == 29 - 1
    assert theorem.spacing_s == pytest.approx(0.02)


def test_with_faults_at_the_plant_only_the_lemma_is_judged(tmp_path: Path) -> None:
    make_log(
        tmp_path / "a.mcap",
        300,
        settings=settings(*CERTIFIED, bits=12),
        truth_every=1,
        injected={100: "motor1:bias=0.5"},
    )
    findings = read(tmp_path / "a.mcap").findings
    assert findings.theorem is not None
    assert (findings.theorem.mean_square_share, findings.theorem.pointwise_share) == (None, None)
    assert findings.reasons["theorem.mean_square_share"] == "faults acted at the plant"
    assert findings.theorem.held is True
