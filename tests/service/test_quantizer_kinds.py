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
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import review
from aeroloop.service.theorem.certificate import certify
from tests.support.certified import certified_settings
from tests.support.made_log import lockstep, make_log

SIGNALS = ("attitude", "rate", "voltage")
TICKS = 600

every_kind = pytest.mark.parametrize("kind", get_args(Kind))


def throughout(kind: str, *more: str) -> Settings:
    """The paper's experiment in lockstep with this kind for all signals."""
    return load_over(lockstep(), [*(f"wire.{signal}.kind={kind}" for signal in SIGNALS), *more])


@every_kind
def test_a_log_is_computed_again_byte_for_byte_and_has_the_figures_of_the_experiment(kind: str, tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, settings=throughout(kind))
    (session,) = replay([tmp_path / "a.mcap"]).sessions
    assert (session.first_tick, session.ticks, session.differ) == (0, TICKS, 0)
    figures, expected = review(tmp_path / "a.mcap"), run_experiment(throughout(kind), TICKS * 0.002)
    assert (figures.z_track, figures.u_total) == (expected.z_track, expected.u_total)
    assert figures.damages == []


@pytest.mark.parametrize("kind", [kind for kind in get_args(Kind) if kind != "uniform"])
def test_a_log_that_begins_in_the_middle_is_replayed_with_what_was_held_then(kind: str, tmp_path: Path) -> None:
    # A motor that is held ten steps farther stays at one level for long: what is held at the start decides much.
    more = ["wire.voltage.hysteresis=8"] if kind == "hysteresis-uniform" else []
    make_log(tmp_path / "a.mcap", TICKS, settings=throughout(kind, *more), begin=305)
    (session,) = replay([tmp_path / "a.mcap"]).sessions
    assert session.first_tick is not None
    assert 250 < session.first_tick < 305  # of the batch that tick 305 is in
    assert (session.ticks, session.differ) == (TICKS - session.first_tick, 0)


@every_kind
def test_an_export_has_the_levels_that_were_sent(kind: str, tmp_path: Path) -> None:
    log, settings = tmp_path / "a.mcap", throughout(kind)
    make_log(log, 200, settings=settings)
    export([log], "parquet", tmp_path / "a.parquet")
    table, wire = pyarrow.parquet.read_table(tmp_path / "a.parquet").to_pydict(), settings.wire
    rows = Recording([log]).session(("aero", "s1")).controller
    for frame, name, i, format_, level in (
        ("command", "voltage_3_V", 1, wire.command, wire.voltage.quantizer().level),
        ("measurement", "rate_z_rad_s", 5, wire.measurement, wire.rate.quantizer().level),
    ):
        sent = [format_.unpack(each.tobytes()) for each in rows[frame]]
        assert table[name] == [level(read[1][i]) for read in sent if read is not None]


@every_kind
def test_the_certificate_takes_the_bound_of_each_kind(kind: str) -> None:
    settings = certified_settings(12, 12, *(f"wire.{signal}.kind={kind}" for signal in SIGNALS))
    found, wire = certify(settings), settings.wire
    assert found.holds
    for symbol, signal, elements in (("‖δ_ε‖", wire.attitude, 3), ("‖δ_ω‖", wire.rate, 3), ("‖δ_u‖", wire.voltage, 3)):
        assert found.value(symbol) == sqrt(elements) * signal.quantizer().bound
