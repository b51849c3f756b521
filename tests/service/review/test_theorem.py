"""Theorem check of a log: true states at their ticks, and the set once entered."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Sinusoid, Stream
from aeroloop.service.config import Settings, load
from aeroloop.service.review import theorem as check
from aeroloop.service.review.panels import NO_TRUTHS
from aeroloop.service.review.report import Check, Findings, TheoremFindings
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read
from aeroloop.service.review.theorem import TheoremCheck, check_theorem, judged_ticks
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.invariant import Reach, reach
from aeroloop.service.theorem.premises import Premises
from tests.support.certified import FREE, bits
from tests.support.edited_log import Said, at_rest, message_of, rewrite
from tests.support.ideal import IDEAL
from tests.support.made_log import SESSION, START_NS, description, lockstep, make_log

TICKS = 4000
CERTIFIED = (*FREE, *bits(12, 12), "plant.rigid_body.damping=[0.006, 0.005, 0.007]")


def settled(*overrides: str) -> Settings:
    """The certified body with the reference's rate and θ̂ = θ from the beginning on."""
    reference = load().reference
    assert isinstance(reference, Sinusoid)
    rate = [radians(a) * f for a, f in zip(reference.amplitude, reference.frequency, strict=True)]
    begins = f"plant.rigid_body.rate={rate}", "law.damping_estimate=[0.006, 0.005, 0.007]"
    return load(overrides=[*CERTIFIED, *begins, *overrides])


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's plant for 8 s, in which the attitude errs most."""
    path = tmp_path_factory.mktemp("theorem") / "ideal.mcap"
    make_log(path, TICKS, settings=lockstep(*IDEAL), truth_every=2)
    return path


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A body of which everything is proven; it begins at rest while its reference moves."""
    path = tmp_path_factory.mktemp("theorem") / "certified.mcap"
    make_log(path, 1500, settings=lockstep(*CERTIFIED), truth_every=1)
    return path


def judged(path: Path) -> tuple[Findings, TheoremFindings]:
    findings = read(path).findings
    assert findings.theorem is not None
    return findings, findings.theorem


def test_a_certified_body_stays_within_the_set_that_it_entered(certified: Path) -> None:
    findings, theorem = judged(certified)
    assert (theorem.holds, theorem.held) == (True, True)
    assert 1000 < theorem.pointwise_judged < 1500
    assert theorem.pointwise_bound is not None
    assert theorem.pointwise_radius is not None
    assert 1 < theorem.pointwise_bound / theorem.pointwise_radius < 1.1
    assert theorem.pointwise_share is not None
    assert 0.1 < theorem.pointwise_share < 1
    assert Limit.parse("theorem.held=1").holds(findings)


def test_a_set_that_is_too_small_is_found_broken(certified: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small(p: Premises, start: float = 0.0) -> Reach | None:
        found = reach(p, start)
        return found and replace(found, radius=found.radius / 3)

    monkeypatch.setattr(check, "reach", small)
    findings, theorem = judged(certified)
    assert theorem.pointwise_share is not None
    assert theorem.pointwise_share > 1
    assert theorem.held is False
    found = "the run broke what is proven"
    assert Limit.parse("theorem.held=1").check(findings) == Check(text="theorem.held ≥ 1", holds=False, found=found)


@pytest.mark.parametrize(("mode", "late"), [("true", 0), ("false", 1)], ids=["lockstep", "real time"])
def test_a_lost_frame_ends_what_was_proven_before_it(tmp_path: Path, mode: str, late: int) -> None:
    """A state proves something of the next ones once a command acts that was computed since."""
    for name, lost in (("whole", []), ("lost", [205])):
        path = tmp_path / f"{name}.mcap"
        make_log(path, 300, settings=settled(f"loop.lockstep={mode}"), truth_every=1, lost=lost)
        _, theorem = judged(path)
        assert (theorem.samples, theorem.held) == (300, True)
        assert theorem.pointwise_judged == 300 - (2 + late) * (1 + len(lost))


def test_a_tick_that_the_plant_skipped_ends_what_was_proven_before_it(tmp_path: Path) -> None:
    """In lockstep, where each command acts at once: the state after the gap starts anew, and proves the next."""
    for name, skipped in (("whole", []), ("skipped", [205])):
        path = tmp_path / f"{name}.mcap"
        make_log(path, 300, settings=settled("loop.lockstep=true"), truth_every=1, skipped=skipped)
        _, theorem = judged(path)
        assert (theorem.samples, theorem.held) == (300 - len(skipped), True)
        assert theorem.pointwise_judged == theorem.samples - 2 - 2 * len(skipped)


@pytest.mark.parametrize(("mode", "tick", "fewer"), [("true", 0, 0), ("true", 1, 1), ("false", 0, 0), ("false", 1, 1)])
def test_in_real_time_two_states_in_a_row_must_be_near_enough(tmp_path: Path, mode: str, tick: int, fewer: int) -> None:
    """A command that acts in real time was computed from the state before.

    A state proves the next from tick 1 on in lockstep, in real time from tick 2 on, whose state before is of tick 1.
    """

    def far(one: Said) -> Said:
        if one.topic != "truth" or (truth := Truth.decode(one.data)).session_tick != tick:
            return one
        return one._replace(data=truth.model_copy(update={"rate": (9.0, 9.0, 9.0)}).encode())

    make_log(log := tmp_path / "a.mcap", 300, settings=settled(f"loop.lockstep={mode}"), truth_every=1)
    _, near = judged(log)
    _, theorem = judged(rewrite(log, tmp_path / "b.mcap", far))
    assert theorem.pointwise_judged == near.pointwise_judged - fewer


def test_with_faults_at_the_plant_nothing_is_judged(tmp_path: Path) -> None:
    settings, injected = lockstep(*CERTIFIED), {100: "motor1:bias=0.5"}
    make_log(tmp_path / "a.mcap", 300, settings=settings, truth_every=1, injected=injected)
    findings, theorem = judged(tmp_path / "a.mcap")
    assert (theorem.holds, theorem.pointwise_share, theorem.held) == (True, None, None)
    assert findings.reasons["theorem.held"] == "faults acted at the plant"
    assert not Limit.parse("theorem.held=1").holds(findings)


def change(tick: int, **parts: Any) -> Change:
    return Change(session=SESSION, tick=tick, **parts)


FIRST = change(0, gains=Gains(), reference=Hold())


@pytest.mark.parametrize(
    ("changes", "span"),
    [
        ([change(7, gains=Gains()), change(40, reference=Hold(), within_s=0.1), change(120, gains=Gains())], (90, 120)),
        ([FIRST, change(120, gains=Gains())], (0, 120)),
        ([FIRST], (0, np.inf)),
        # An approach from where the body was found, which takes a second.
        ([FIRST, change(3, reference=Hold(), within_s=1.0, start=(0.0, 10.0, 60.0)), change(12_000, gains=Gains())],
         (503, 12_000)),
    ],
)  # fmt: skip
def test_a_session_is_judged_from_the_end_of_its_approach_until_the_next_change(
    changes: list[Change], span: tuple[int, float]
) -> None:
    assert judged_ticks(changes, 0.002) == span


def held(settings: Settings, **values: float) -> dict[str, Any]:
    """A certificate that holds, as the controller's description carries it."""
    return {**certify(settings).model_dump(mode="json"), "violated": [], "holds": True, "plant_deg": 40.0, **values}


def test_the_descriptions_certificate_is_what_counts_unless_the_session_began_with_other_gains(
    ideal: Path, tmp_path: Path
) -> None:
    settings = lockstep(*IDEAL)
    half = held(settings, plant_radius=0.5)
    its = description(settings, "controller").model_copy(update={"certificate": half})
    more = [message_of("description", its, START_NS - 10**9)]
    assert judged(rewrite(ideal, tmp_path / "a.mcap", more=more))[1].pointwise_radius == 0.5
    other = change(0, gains=Gains(C1=(0.4, 0.3, 0.3)), reference=settings.reference)
    for changes, holds in (([], True), ([other], False)):
        assert check_theorem(settings, at_rest([0]), NO_TRUTHS, changes, half).findings.holds is holds


def test_of_a_stream_and_of_gains_that_fail_nothing_is_guaranteed() -> None:
    def trial(change: Change) -> TheoremCheck:
        return check_theorem(load(overrides=["reference.kind=hold"]), at_rest([0]), NO_TRUTHS, [change])

    stream = trial(change(0, reference=Stream()))
    nothing = stream.findings
    assert (nothing.holds, nothing.held, nothing.pointwise_radius) == (None, None, None)
    assert all("stream" in stream.reasons[f"theorem.{name}"] for name in ("pointwise_radius", "held"))
    failed = trial(change(0, gains=Gains(C1=(3.0, 3.0, 3.0)), reference=load().reference))
    assert (failed.findings.holds, failed.findings.pointwise_deg) == (False, None)
    assert failed.reasons["theorem.pointwise_share"] == "the certificate does not hold"
