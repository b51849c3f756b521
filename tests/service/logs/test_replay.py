"""Replay of logs: the same bytes or the first difference; whole parts of broken files."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.service.config import load
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.replay import EndReplay, SessionReplay, replay
from aeroloop.service.review.review import review
from tests.support.made_log import AN_OPERATORS_WORDS, SESSION, lockstep, made, make_log, write

TICKS = 600


def replayed(path: Path, *overrides: str) -> SessionReplay:
    (session,) = replay([path], overrides).sessions
    return session


@pytest.mark.parametrize(("begin", "known"), [(1, 250), (123, 250), (305, 305)])
def test_a_log_that_begins_in_the_middle_is_replayed_from_its_first_known_tick(
    tmp_path: Path, begin: int, known: int
) -> None:
    """The record in the trace says since when gains and reference are in force; no batch has the plant's state."""
    changes = {k: change for k, change in AN_OPERATORS_WORDS.items() if k < 400}
    make_log(tmp_path / "a.mcap", TICKS, begin=begin, changes=changes)
    both = replay([tmp_path / "a.mcap"])
    (session,) = both.sessions
    assert session.first_tick is not None
    assert known <= session.first_tick < known + 60
    assert both.controller == EndReplay(ticks=TICKS - session.first_tick, differ=0)
    assert both.plant is None
    assert both.reasons == {"plant": "the log lacks the plant's first row, so the plant's state is not known"}


def test_the_first_command_that_differs_is_named(tmp_path: Path) -> None:
    """The plant acted on what the controller sent, not on what it wrote down."""
    sound = made(lockstep(), 50, session="sound", at_ns=3_600_000_000_000)
    both = replay([write(tmp_path / "a.mcap", lockstep(), [*sound, *made(lockstep(), TICKS, spoil=321)])])
    (session,) = (one for one in both.sessions if one.session == SESSION)
    assert [one.differ for one in both.sessions if one != session] == [0]
    assert session.differ == 1
    assert session.first_difference is not None
    assert session.first_difference.tick == 321
    assert session.first_difference.time_s == pytest.approx(0.642)
    logged, computed = (
        bytes.fromhex(text) for text in (session.first_difference.logged, session.first_difference.computed)
    )
    assert logged[-1] ^ computed[-1] == 0x10
    (signal,) = both.details["controller"]
    volts = [signal.split()[i] for i in (1, 4)]
    steps = abs(float(volts[0]) - float(volts[1])) / (48 / 63)  # (2·y_max)/(2^R − 1)
    assert signal == f"u3: {volts[0]} V logged, {volts[1]} V computed, {steps:.0f} steps apart"
    assert "details" not in both.model_dump()


def test_with_another_law_it_reports_what_would_have_been_commanded(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS)
    session = replayed(tmp_path / "a.mcap", "law.C2=[0.3, 0.3, 0.3]")
    assert session.differ > TICKS / 2
    assert replay([tmp_path / "a.mcap"], ["law.C2=[0.3, 0.3, 0.3]"]).plant is None
    assert session.max_v is not None
    assert session.max_v > 0.7  # at least a step of the voltage's quantizer
    assert session.u_total_computed != session.u_total_logged


def test_the_figures_of_a_made_log_are_those_of_the_experiment(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS)
    figures, expected = review(tmp_path / "a.mcap"), run_experiment(load(), TICKS * 0.002)
    assert (figures.z_track, figures.u_total) == (expected.z_track, expected.u_total)
    assert figures.damages == []
