"""Attack: the batch is the loop, the search repeats and resumes, beats what was once claimed, not what is proven.

`old_claim` is what the certificate said before it had a bound at every instant: the paper's (C.68), with the paper's
own (C.26) and (C.56). It said that ‖z‖ ends within √(δ_Q/k), whatever the wire's ranges are.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import asin, pi
from pathlib import Path

import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.wire.quantizer import UniformQuantizer
from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import Settings, load, with_bits
from aeroloop.service.control.reference import desired
from aeroloop.service.lab import attack as attacks
from aeroloop.service.lab.attack import ROUND, Attack, attack, experiments
from aeroloop.service.lab.attack_rounds import AttackError
from aeroloop.service.lab.attacked_lemma import SIZE, Instants
from aeroloop.service.lab.attacked_loops import Experiments, Loops, Outcome, balance, quantized
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.theorem.bounds import Theorem, lemma_1, theorem_1
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import evaluate
from aeroloop.service.theorem.invariant import Premises, Reach, reach
from aeroloop.service.theorem.lemma import coordinates
from tests.support.certified import FREE
from tests.support.certified import bits as overrides_of

SMALL = ["law.damping_bound=0.0119"]
SHORT = 3.0
"""Length of an experiment [s]: the error equations decay within 2 s."""
TURNED = (*FREE, "plant.rigid_body.attitude=[0.999, 0.01, 0.03, 0.02]", "wire.voltage.limit=12")
"""The paper's law on a body with three motors, through real frames."""


def settings_of(out: str, inp: str, *changes: str) -> Settings:
    return with_bits(load(overrides=[*SMALL, *changes]), out, inp)


def old_claim(settings: Settings) -> Theorem:
    error = settings.controller.start_within_deg
    while True:
        known = evaluate(settings, attitude_error_deg=error).known
        p = replace(known, hold=0.0, k_theta_hat=known.k_theta)
        k_omega_e, d = 1 + p.C1_max, lemma_1(p)
        d = replace(
            d,
            k_omega_e=k_omega_e,
            delta_Psi2=2 * p.lambda_J * p.delta_omega * k_omega_e,
            delta_S2=k_omega_e * d.delta_R,
            delta_alpha2=p.C1_max * k_omega_e,
        )
        t = theorem_1(p, d)
        assert t.radius is not None
        ends_within = 180 / pi * 4 * asin(min(1.0, t.radius / 2))  # the assumed error must not be smaller
        if min(180.0, ends_within) <= error * (1 + 1e-6):
            return t
        error = min(180.0, ends_within)


def any_experiments(settings: Settings, rows: int, quantizers: bool = True) -> Experiments:
    """Random ones from x = 0, with damping that damps."""
    points = np.random.default_rng(3).uniform(-1, 1, (rows, 34))
    points[:, :3] = np.abs(points[:, :3])
    return experiments(
        points, with_theorem(settings).law.damping_bound, 0.0, np.zeros(rows), np.full(rows, float(quantizers))
    )


def largest(found: Attack, what: str, errors: str, *, start: bool = False) -> float:
    """Found over bound."""
    shares = [s.share for s in found.statements if (s.what, s.errors, bool(s.start)) == (what, errors, start)]
    assert shares[0] is not None
    return shares[0]


@pytest.mark.parametrize("bits", ["8", "cont"])
def test_a_row_of_the_batch_is_the_loop_that_runs_through_real_frames(bits: str) -> None:
    settings = with_bits(load(overrides=TURNED), bits, bits)
    law, body, ticks = with_theorem(settings).law, settings.plant.rigid_body, 2000
    plant = settings.plant.build(settings.loop.period)
    assert isinstance(plant, EmulatedPlant)
    q, omega = [], []

    def watch(_k: int, _measurement: bytes, _command: bytes) -> None:
        truth = plant.truth()
        q.append(truth.attitude)
        omega.append(truth.rate)

    run_experiment(settings, ticks * settings.loop.period, watch=watch, plant=plant)
    wanted = desired(settings.reference, settings.loop.period, ticks)
    q_d, omega_d = wanted[:, :4], wanted[:, 4:7]
    c = coordinates(np.array(q), np.array(omega), q_d, omega_d, np.ones(ticks), np.array(law.C1))

    theta, theta_hat = np.array([body.damping]), np.array([law.damping_estimate])
    start = np.hstack([c.eps_e[:1], c.z2[:1]]) - balance(settings, q_d[:1], omega_d[:1], theta - theta_hat)
    loops = Loops(settings, 1, ticks)
    chosen = any_experiments(settings, 1)
    loops.begin(
        replace(chosen, start=start, theta=theta, theta_hat=theta_hat, phase=np.zeros(1), offset=np.zeros((1, 9)))
    )
    found = loops.advance(ticks)
    # A Runge–Kutta step of 2 ms or two of 1 ms differ by 1e-12; a level that flips for it would show in ‖z‖.
    assert found.z[0] == pytest.approx(c.norm.max(), rel=1e-9)
    assert found.omega[0] == pytest.approx(np.abs(omega).max(), rel=1e-9)
    assert found.square[0] == pytest.approx(settings.loop.period * (c.norm**2).sum(), rel=1e-9)


@pytest.mark.parametrize("deadzone", [None, 0.03])
def test_the_quantizer_as_an_expression_is_the_quantizer(deadzone: float | None) -> None:
    quantizer = UniformQuantizer(5, 1.5, deadzone)
    edges = quantizer.deadzone + quantizer.step * np.arange(20)
    values = np.concatenate([np.random.default_rng(0).uniform(-2, 2, 500), edges, -edges, [0.0]])
    y = ca.SX.sym("y")
    found = ca.Function("q", [y], [quantized(y, quantizer)]).map(len(values))(values[None]).full()[0]
    assert found == pytest.approx([quantizer.quantize(value) for value in values], abs=1e-12)


@pytest.mark.parametrize(("out", "inp"), [("8", "6"), ("12", "12")])
def test_a_search_does_not_beat_what_is_proven_and_would_beat_less(out: str, inp: str) -> None:
    found = attack(settings_of(out, inp), 2 * ROUND, duration_s=SHORT, disturbance=0.0005)
    assert not found.beaten
    assert {s.what for s in found.statements} >= {"‖z‖", "|ω_k|", "|ε_k|", "|u_k|", "mean square", "C.53", "C.57"}
    # Three tenths of the bound would not have passed; of the innermost set, two tenths.
    assert max(largest(found, "‖z‖", "any", start=start) for start in (False, True)) > 0.3
    assert largest(found, "‖z‖", "any") > 0.2


@pytest.mark.processes
def test_what_beats_a_bound_is_reported_and_exits_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Two workers compute, whenever they do: no time is in it."""

    def too_small(p: Premises, start: float = 0.0) -> Reach | None:
        at = reach(p, start)
        return at and replace(at, radius=0.3 * at.radius)

    file = tmp_path / "rounds.jsonl"
    words = ("lab", "attack", "--set", *SMALL, "--runs", str(ROUND), "--duration", str(SHORT), "--out", str(file))
    assert run(words) == 0
    printed = capsys.readouterr().out
    assert "Not beaten" in printed
    assert "path: compiled" in printed
    monkeypatch.setattr(attacks, "reach", too_small)
    assert run(words) == 1  # the same experiments, read from the file
    assert "Beaten: ‖z‖" in capsys.readouterr().out
    assert run((*words, "--json")) == 1
    assert json.loads(capsys.readouterr().out)["beaten"]
    assert run((*words, "--seed", "1")) == 1
    assert "another configuration, seed" in capsys.readouterr().err


def test_a_search_resumes_where_its_file_ends(tmp_path: Path) -> None:
    settings, file = settings_of("8", "6", "reference.kind=hold"), tmp_path / "rounds.jsonl"
    whole = attack(settings, 2 * ROUND, duration_s=0.1, out=tmp_path / "whole.jsonl")
    attack(settings, 1, duration_s=0.1, out=file)
    first = file.read_bytes()
    attack(settings, 2 * ROUND, duration_s=0.1, out=file)
    file.write_bytes(file.read_bytes()[:-100])  # killed while it wrote the second
    resumed = attack(settings, 2 * ROUND, duration_s=0.1, out=file)
    assert file.read_bytes().startswith(first)
    assert file.read_bytes() == (tmp_path / "whole.jsonl").read_bytes()
    assert resumed.statements == whole.statements

    file.write_text("a diary")
    with pytest.raises(AttackError, match="does not hold a search"):
        attack(settings, 1, out=file)
    assert file.read_text() == "a diary"


def test_lemma_1_is_nearly_reached_and_half_of_it_is_broken() -> None:
    settings = settings_of("8", "6")
    found = attack(settings, 4 * ROUND, duration_s=0.01)
    shares = {s.what: s.found for s in found.statements if s.errors is None}
    assert not found.beaten
    assert min(shares[name] for name in ("C.26", "C.52", "C.53", "C.57")) > 0.85

    e = evaluate(settings)
    half = replace(e, lemma=replace(e.lemma, delta_R=e.lemma.delta_R / 2))
    points = np.random.default_rng(0).uniform(-1, 1, (500, SIZE))
    assert Instants(settings, half).shares(points)["C.53"].max() > 1


def ended(settings: Settings, chosen: Experiments, settle_s: float, judged_s: float) -> Outcome:
    """Outcome of the time after `settle_s`."""
    settle, judged = settings.loop.ticks(settle_s), settings.loop.ticks(judged_s)
    loops = Loops(settings, len(chosen.theta), settle + judged)
    loops.begin(chosen)
    loops.advance(settle)
    loops.forget()
    return loops.advance(judged)


def test_the_old_claim_is_beaten_where_the_damping_is_not_the_estimated() -> None:
    claim = old_claim(with_bits(load(), "8", "6"))
    assert [claim.k, claim.radius] == pytest.approx([0.065818, 0.20043], rel=1e-4)

    settings = with_bits(load(), "16", "16")
    claim = old_claim(settings)
    assert claim.radius is not None
    found = ended(settings, any_experiments(settings, 64), 20.0, 4.0)
    assert found.lasted == pytest.approx(4.0)  # within the ranges: every premise holds
    assert found.z.max() > 1.5 * claim.radius


@pytest.mark.parametrize("bits", ["3", "4"])
def test_the_old_claim_held_where_the_loop_leaves_the_wire_s_ranges(bits: str) -> None:
    settings = with_bits(load(), bits, bits)
    assert old_claim(settings).margin > 0
    found = ended(settings, any_experiments(settings, 128), 0.0, 9.0)
    assert found.lasted.max() < 1.0
    assert found.u.max() > settings.wire.voltage.limit
    assert evaluate(settings).body_reach is None  # nothing is claimed now


def test_a_certificate_prints_the_largest_that_an_attack_found_beside_its_bound(
    capfd: pytest.CaptureFixture[str],
) -> None:
    overrides = [word for change in (*FREE, *overrides_of(12, 12)) for word in ("--set", change)]
    assert run(("lab", "certify", "--attack", "256", "--json", *overrides)) == 0
    found = json.loads(capfd.readouterr().out)
    assert 0.1 * found["pointwise_radius"] < found["largest_found"] <= found["pointwise_radius"]
