"""Ticks of a log: decoded frames by frames, recomputed columns by the loop's own telemetry, and by SPEC.md alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeroloop.protocol.messages.models import Telemetry
from aeroloop.protocol.messages.trace import Outcome, PlantRow, Received, Sent, TraceWriter, read_batch
from aeroloop.service.config import Settings, load
from aeroloop.service.control.laws.registry import initial_state, law_of
from aeroloop.service.daemon.tick_source import PlantTick
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.replay import EndReplay, replay
from aeroloop.service.logs.ticks import Ticks, clock_offset, recompute
from aeroloop.service.review.review import review
from aeroloop.service.testing.hil_log import HilLog
from tests.golden.make import HERE as GOLDEN
from tests.support import own_laws
from tests.support.edited_log import Said, rewrite
from tests.support.ideal import IDEAL
from tests.support.made_log import (
    AN_OPERATORS_WORDS,
    RUNS,
    SESSION,
    VEHICLE,
    Clock,
    ControllerEnd,
    Messages,
    lockstep,
    make_log,
    write,
)
from tests.support.own_laws import EXPRESSIONS, HERE, PYTHON

CONTINUOUS = [f"wire.{signal}.bits=cont" for signal in ("attitude", "rate", "voltage")]
ON_CHANGE = "wire.transmit=on_change"
WIRES = {
    "default": [],
    "coarse": ["wire.attitude.bits=2", "wire.rate.bits=3", "wire.voltage.bits=2", ON_CHANGE],
    "continuous": CONTINUOUS,
    "mixed": ["wire.attitude.bits=cont", "wire.rate.bits=16", "wire.rate.deadzone=0.01", ON_CHANGE],
    "hysteresis": [f"wire.{signal}.kind=hysteresis-uniform" for signal in ("attitude", "rate", "voltage")],
    "rigid body": ["wire.actuators=3", "plant.kind=rigid_body", *IDEAL, ON_CHANGE],
}


def bits(values: Any) -> list[int]:
    """Doubles as integers: NaN equals itself, and −0 is not 0."""
    found: list[int] = np.asarray(values, dtype=np.float64).ravel().view(np.int64).tolist()
    return found


def check_by_telemetry(ticks: Ticks, log: Path, settings: Settings) -> None:
    """What was computed is what telemetry said."""
    names = list(initial_state(law_of(settings.law, settings.loop.period, settings.wire.actuators)))
    at = {k: i for i, k in enumerate(ticks.k.tolist())}
    published = 0
    for _, telemetry in HilLog(log).messages(Telemetry):
        i = at[telemetry.tick]
        assert bits(ticks.attitude_error[i]) == bits(telemetry.attitude_error)
        assert bits(ticks.rate_error[i]) == bits(telemetry.rate_error)
        assert bits(ticks.unquantized[i]) == bits(telemetry.voltages)
        assert bits(ticks.state_next[i]) == bits([x for name in names for x in telemetry.state[name]])
        published += 1
    assert published > 40


@pytest.mark.parametrize(
    ("kind", "wire"),
    [
        *(("adaptive", wire) for wire in WIRES),
        *((kind, "mixed") for kind in (EXPRESSIONS, PYTHON, "adaptive-torque", f"{HERE}:Bare")),
    ],
)
def test_a_log_of_any_law_and_wire_is_computed_again_as_it_was(kind: str, wire: str, tmp_path: Path) -> None:
    """What was computed is what telemetry said; every command replays byte for byte, also from the middle on."""
    settings, log = load(overrides=["loop.lockstep=true", f"law.kind={kind}", *WIRES[wire]]), tmp_path / "a.mcap"
    changes = AN_OPERATORS_WORDS if kind == "adaptive" else {250: AN_OPERATORS_WORDS[250]}
    make_log(log, 500, settings=settings, changes=changes, lost={30, 31, 300})
    assert replay([log]).controller == EndReplay(ticks=497, differ=0)
    ticks = recompute(Recording([log]).session((VEHICLE, SESSION))).ticks
    check_by_telemetry(ticks, log, settings)
    make_log(log, 500, settings=settings, changes={}, begin=260)
    both = replay([log])
    if both.controller is not None:
        assert both.controller.differ == 0


def test_ticks_without_a_valid_measurement_are_left_out_of_every_column(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    make_log(log, 500, settings=lockstep(), injected={100: "rate:off", 120: None})
    found = recompute(Recording([log]).session((VEHICLE, SESSION)))
    assert found.ticks.k.tolist() == [k for k in range(500) if not 100 <= k < 120]
    assert {len(column) for column in found.ticks} == {480}
    assert not np.isnan(found.ticks.unquantized).any()
    check_by_telemetry(found.ticks, log, lockstep())


def test_the_offset_of_two_clocks_is_that_of_the_frames_that_did_not_queue() -> None:
    """Both ways take 150 µs and the clocks differ by 5 s; every third command waits in a queue for up to 20 ms."""
    waits_ns = np.where(np.arange(1024) % 3 == 0, np.random.default_rng(1).uniform(1e6, 2e7, 1024), 0.0)
    offset = clock_offset(np.full(1024, 5e9 + 150e3), 150e3 - 5e9 + waits_ns)
    assert offset == pytest.approx(5e9, abs=1.0)


def test_ticks_that_were_not_computed_do_not_run_a_law_in_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law that hung once hangs whenever it is run: a reader of its log needs the errors, and no voltages."""
    lost = {50, 51, 52, 120}
    settings = load(overrides=["loop.lockstep=true", f"law.kind={PYTHON}"])
    make_log(tmp_path / "a.mcap", 200, settings=settings, lost=lost)
    runs, step = list[object](), own_laws.Python.step

    def counted(law: Any, now: Any) -> Any:
        runs.append(now)
        return step(law, now)

    monkeypatch.setattr(own_laws.Python, "step", counted)
    found = recompute(Recording([tmp_path / "a.mcap"]).session((VEHICLE, SESSION)))
    assert len(runs) == 200 - len(lost)
    assert set(found.missed.tolist()) == lost
    its = found.ticks.where(np.isin(found.ticks.k, list(lost)))
    assert np.isnan(its.unquantized).all()
    assert len(its.k) == len(lost)
    for column in (its.attitude, its.desired, its.rate, its.attitude_error, its.rate_error):
        assert not np.isnan(column).any()


def test_a_tick_that_was_not_computed_leaves_the_laws_state_as_it_was(tmp_path: Path) -> None:
    lost = {50, 51, 52, 120}
    make_log(tmp_path / "a.mcap", 200, settings=lockstep(), lost=lost)
    ticks = recompute(Recording([tmp_path / "a.mcap"]).session((VEHICLE, SESSION))).ticks
    assert ticks.k.tolist() == list(range(200))
    for k in lost:
        before = max(set(range(k)) - lost)
        assert ticks.state_next[k].tolist() == ticks.state_next[before].tolist()
        assert np.isnan(ticks.state[k]).all()
    assert (ticks.state_next[53] != ticks.state_next[49]).any()


def test_a_state_is_taken_from_the_log_only_after_missing_rows(tmp_path: Path) -> None:
    """Every batch has the controller's state before it; one that nothing contradicts is what was computed."""
    make_log(log := tmp_path / "a.mcap", 500, settings=lockstep())

    def otherwise(one: Said) -> Said:
        batch = read_batch(one.data) if one.key.endswith("trace/controller") else None
        if batch is None or batch.tail.state is None or batch.header.first_row == 0:
            return one
        tail = one.data[len(one.data) - batch.header.tail_bytes :]
        state = json.loads(tail)
        state["state"]["law"]["damping_estimate"] = [0.5, 0.5, 0.5]
        text = json.dumps(state).encode()
        head = one.data[:12] + len(text).to_bytes(4, "little")
        return one._replace(data=head + one.data[16 : len(one.data) - len(tail)] + text)

    edited = rewrite(log, tmp_path / "b.mcap", otherwise)
    assert replay([edited]).controller == EndReplay(ticks=500, differ=0)
    its, whole = (recompute(Recording([path]).session((VEHICLE, SESSION))).ticks for path in (edited, log))
    assert (its.state == whole.state).all()


def test_the_sign_of_q_goes_on_where_only_the_plant_has_a_tick(tmp_path: Path) -> None:
    """A body that turns by a degree a tick, whose measurements have η ≥ 0: past half a turn q is the negative one."""
    settings, messages, clocks = load(), Messages(), (Clock("plant"), Clock("controller"))
    wire, end = settings.wire, ControllerEnd(settings, messages, clocks[1])
    plant = TraceWriter("plant", wire, RUNS["plant"])
    plant.session = SESSION
    for k in range(400):
        for clock in clocks:
            clock.now_ns = k * settings.loop.period_ns
        half = np.radians(k) / 2
        eps = 0.0, 0.0, np.sin(half) * np.sign(np.cos(half))
        codes = [wire.attitude.quantizer().encode(x) for x in eps] + [wire.rate.quantizer().encode(0.0)] * 3
        frame, at_ns = wire.measurement.pack(k % wire.measurement.counters, codes), clocks[1].monotonic_ns()
        if not 250 <= k < 300:
            command = end.controller.tick(frame, k)
            end.record(PlantTick(k, frame, Received.FRAME, at_ns, at_ns), command, at_ns)
        sent_ns, none = clocks[0].monotonic_ns(), bytes(wire.command.size)
        plant.row(PlantRow(k, k, Sent.FRAME, Sent.NONE, Outcome.NONE, 0, -1, sent_ns, 0, frame, none, (0.0, 0.0)))
        if k % 200 == 199:
            messages.add("trace", plant.take(sent_ns, clocks[0].time_ns(), final=k == 399), clocks[0], "plant")
    end.publish(final=True)
    log = write(tmp_path / "a.mcap", settings, messages.all)
    ticks = recompute(Recording([log]).session((VEHICLE, SESSION))).ticks
    assert ticks.k.tolist() == list(range(400))
    assert np.abs(np.diff(ticks.attitude, axis=0)).max() < 0.2  # of η where ε has its outermost level, 0.996
    assert ticks.attitude[-1, 0] < -0.9


def test_ticks_and_z_track_are_found_by_the_specification_alone() -> None:
    """A program of 40 lines, which imports mcap and numpy: tests/readers/read_trace.py."""
    program = Path(__file__).parents[2] / "readers" / "read_trace.py"
    lines = [line for line in program.read_text().splitlines() if line.startswith(("import", "from"))]
    assert lines == ["import sys", "import numpy as np", "from mcap.reader import make_reader"]
    log = GOLDEN / "can.mcap"
    run = subprocess.run([sys.executable, program, log], capture_output=True, text=True, check=True)
    controller, plant, z_track = run.stdout.split()
    (extent,) = Recording([log]).extents.values()
    assert {"controller": int(controller), "plant": int(plant)} == extent.rows
    assert float(z_track) == pytest.approx(review(log).z_track, rel=1e-12)
