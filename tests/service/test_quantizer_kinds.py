"""Kinds of quantizers through the whole loop: log, replay and certificate."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import get_args

import pyarrow.parquet
import pytest

from aeroloop.protocol.wire.spec import Kind
from aeroloop.service.config import Settings, load_over
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.export import export
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.replay import SessionReplay, replay
from aeroloop.service.review.review import read, review
from aeroloop.service.theorem.certificate import certify
from tests.support.certified import certified_settings
from tests.support.made_log import lockstep, make_log

SIGNALS = ("attitude", "rate", "voltage")
OTHERS = [kind for kind in get_args(Kind) if kind != "uniform"]
TICKS = 600

every_kind = pytest.mark.parametrize("kind", get_args(Kind))
other_kinds = pytest.mark.parametrize("kind", OTHERS)


def throughout(kind: str, *more: str) -> Settings:
    """The paper's experiment in lockstep with this kind for all signals."""
    return load_over(lockstep(), [*(f"wire.{signal}.kind={kind}" for signal in SIGNALS), *more])


def replayed(path: Path) -> SessionReplay:
    (session,) = replay([path]).sessions
    return session


@other_kinds
def test_a_log_that_begins_in_the_middle_is_replayed_with_what_was_held_then(kind: str, tmp_path: Path) -> None:
    # A motor that is held ten steps farther stays at one level for long: what is held at the start decides much.
    more = ["wire.voltage.hysteresis=8"] if kind == "hysteresis-uniform" else []
    make_log(tmp_path / "a.mcap", TICKS, settings=throughout(kind, *more), begin=305)
    session = replayed(tmp_path / "a.mcap")
    assert session.first_tick is not None
    assert 250 < session.first_tick < 305  # of the batch that tick 305 is in
    assert (session.ticks, session.differ) == (TICKS - session.first_tick, 0)


@every_kind
def test_a_log_is_computed_again_byte_for_byte_and_has_the_figures_of_the_experiment(kind: str, tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=throughout(kind))
    session = replayed(tmp_path / "a.mcap")
    assert (session.first_tick, session.ticks, session.differ) == (0, TICKS, 0)
    figures, expected = review(tmp_path / "a.mcap"), run_experiment(throughout(kind), TICKS * 0.002)
    assert (figures.z_track, figures.u_total) == (expected.z_track, expected.u_total)
    assert figures.damages == []


@other_kinds
def test_review_and_export_have_the_levels_that_were_sent_and_which_saturated(kind: str, tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "a.parquet"
    settings = throughout(kind, "wire.voltage.limit=2")
    make_log(log, 200, settings=settings)
    shares = read(log).findings.saturated
    assert 0 < shares["voltage"] < 1
    assert shares["attitude"] == 0
    export([log], "parquet", out)
    table, wire = pyarrow.parquet.read_table(out).to_pydict(), settings.wire
    quantizer = wire.voltage.quantizer()
    rows = Recording([log]).session(("aero", "s1")).controller
    sent = [wire.command.unpack(frame.tobytes()) for frame in rows["command"]]
    codes = [frame[1] for frame in sent if frame is not None]
    assert len(codes) == 200
    for i, name in enumerate(("voltage_2", "voltage_3")):
        assert table[f"{name}_V"] == [quantizer.level(both[i]) for both in codes]
        assert table[f"saturated_{name}"] == [abs(both[i]) == 31 for both in codes]
    seen = [wire.measurement.unpack(frame.tobytes()) for frame in rows["measurement"]]
    level = wire.rate.quantizer().level
    assert table["rate_z_rad_s"] == [level(frame[1][5]) for frame in seen if frame is not None]


@every_kind
def test_the_certificate_takes_the_bound_of_each_kind(kind: str) -> None:
    settings = certified_settings(12, 12, *(f"wire.{signal}.kind={kind}" for signal in SIGNALS))
    found, wire = certify(settings), settings.wire
    assert found.holds
    for symbol, signal, elements in (("‖δ_ε‖", wire.attitude, 3), ("‖δ_ω‖", wire.rate, 3), ("‖δ_u‖", wire.voltage, 3)):
        assert found.value(symbol) == sqrt(elements) * signal.quantizer().bound
