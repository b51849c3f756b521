"""A replay gives the very bytes that were logged, or names the first that differs; broken files give what they hold."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from protocol import topics
from service.config import load
from service.figures import Figures, Stream
from service.lab.experiment import run_experiment
from service.logs.files import LogFiles, ReviewError
from service.logs.limits import Limit, LimitError
from service.logs.mcap_file import CHANGE_METADATA
from service.logs.replay import SessionReplay, replay
from service.logs.review import review
from tests.service.logs.made_log import AN_OPERATORS_WORDS, make_log
from tests.service.logs.retold import retell

TICKS = 600


def replayed(path: Path, *overrides: str) -> SessionReplay:
    (session,) = replay([path], overrides)
    return session


def test_every_command_of_a_log_is_computed_again_byte_for_byte(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS)
    session = replayed(tmp_path / "a.mcap")
    assert (session.first_tick, session.commands, session.differing) == (0, TICKS, 0)
    assert session.first_difference is None


def test_the_golden_log_gives_the_commands_that_it_always_gave() -> None:
    """Recorded once, with an operator's words in it: whatever changes the law's bytes shows here."""
    session = replayed(Path(__file__).parent / "golden.mcap")
    assert (session.first_tick, session.commands, session.differing) == (0, 500, 0)


def test_what_an_operator_changed_is_changed_in_the_replay_at_the_same_tick(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, changes=AN_OPERATORS_WORDS)
    session = replayed(tmp_path / "a.mcap")
    assert (session.commands, session.differing) == (TICKS, 0)


def test_a_change_that_a_rotated_run_tells_again_is_known_once(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, changes=AN_OPERATORS_WORDS)
    changes = LogFiles([tmp_path / "a.mcap"]).changes["aero", "s1"]
    again = [
        (CHANGE_METADATA, {"key": topics.key("change", "aero"), "json": change.model_dump_json()}) for change in changes
    ]
    retold = retell(tmp_path / "a.mcap", tmp_path / "b.mcap", metadata=again)
    assert [change.tick for change in LogFiles([retold]).changes["aero", "s1"]] == [0, 120, 250, 400]


@pytest.mark.parametrize("begin", [1, 7, 123, 305])
def test_a_log_that_begins_in_the_middle_is_replayed_from_its_first_telemetry_on(tmp_path: Path, begin: int) -> None:
    make_log(tmp_path / "a.mcap", TICKS, begin=begin, changes=AN_OPERATORS_WORDS)
    session = replayed(tmp_path / "a.mcap")
    told = -(-begin // 10) * 10
    assert session.first_tick == told + 1  # the telemetry's own command had been computed before
    assert (session.commands, session.differing) == (TICKS - told - 1, 0)


def test_the_first_command_that_differs_is_named(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS, spoil=321)
    session = replayed(tmp_path / "a.mcap")
    assert session.differing == 1
    assert session.first_difference is not None
    assert session.first_difference.tick == 321
    assert session.first_difference.time_s == pytest.approx(0.642)
    logged, computed = (
        bytes.fromhex(text) for text in (session.first_difference.logged, session.first_difference.computed)
    )
    assert logged[1] ^ computed[1] == 1


def test_with_another_law_it_says_what_would_have_been_commanded(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS)
    session = replayed(tmp_path / "a.mcap", "law.C2=[0.3, 0.3, 0.3]")
    assert session.differing > TICKS / 2
    assert session.max_v is not None
    assert session.max_v > 0.7  # at least a step of the voltage's quantizer
    assert session.u_total_computed != session.u_total_logged


def test_the_figures_of_a_made_log_are_those_of_the_experiment(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", TICKS)
    figures, expected = review(tmp_path / "a.mcap"), run_experiment(load(), TICKS * 0.002)
    assert (figures.z_track, figures.u_total) == (expected.z_track, expected.u_total)
    assert figures.damages == []


# Broken files


def test_a_file_cut_anywhere_gives_what_was_whole_before_the_cut_and_says_so(tmp_path: Path) -> None:
    """At 300 places, and at every byte of the last chunk's neighbourhood; a chunk of 100 ticks is the unit of loss."""
    whole = tmp_path / "a.mcap"
    make_log(whole, TICKS, changes=AN_OPERATORS_WORDS)
    data = whole.read_bytes()
    ends = _chunks(data, whole)
    rng = random.Random(1)
    cut = tmp_path / "cut.mcap"
    for size in {*(rng.randrange(8, len(data)) for _ in range(300)), *(end + d for end in ends for d in (-1, 0, 1))}:
        cut.write_bytes(data[:size])
        complete = sum(end <= size for end in ends)
        if complete == 0:
            continue
        (session,) = replay([cut])
        assert session.differing == 0
        assert session.commands >= 100 * complete - 1  # the last command waits for a later measurement
        if size < ends[-1]:
            assert LogFiles([cut]).damages[cut]


def _chunks(data: bytes, path: Path) -> list[int]:
    """Where each chunk ends."""
    ends, at = [], 8
    while at < len(data) - 8:
        opcode, length = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        at += 9 + length
        if opcode == Opcode.CHUNK:
            ends.append(at)
    assert len(ends) >= TICKS // 100, path
    return ends


def test_a_damaged_chunk_is_stepped_over_and_named(tmp_path: Path) -> None:
    """In real time, where the times of publication tell the ticks after the gap; in lockstep only counters do."""
    path = tmp_path / "a.mcap"
    make_log(path, TICKS, settings=load())
    data = bytearray(path.read_bytes())
    ends = _chunks(bytes(data), path)
    data[(ends[2] + ends[1]) // 2] ^= 0xFF  # within the third chunk
    path.write_bytes(data)
    figures = review(path)
    assert len(figures.damages) == 1
    assert "a chunk" in figures.damages[0]
    assert figures.command.frames_per_s is not None
    assert figures.skipped_ticks == 100  # its ticks, and no others


def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path) -> None:
    for content in (b"", b"something else", b"\x89MCAP0\r\n"):
        (tmp_path / "a.mcap").write_bytes(content)
        with pytest.raises(ReviewError) as refused:
            review(tmp_path / "a.mcap")
        assert len(str(refused.value).splitlines()) == 1
    with pytest.raises(ReviewError, match=r"no \.mcap file"):
        LogFiles([_empty(tmp_path)])


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def test_a_folder_is_read_as_one_run_in_the_order_of_time(tmp_path: Path) -> None:
    """Two recorders by turns, whose file names sort the other way round."""
    make_log(tmp_path / "b.mcap", 300)
    make_log(tmp_path / "a.mcap", TICKS, begin=300)
    (tmp_path / "whole").mkdir()
    make_log(tmp_path / "whole" / "w.mcap", TICKS)
    parts, whole = review(tmp_path), review(tmp_path / "whole")
    assert (parts.z_track, parts.u_total, parts.duration_s) == (whole.z_track, whole.u_total, whole.duration_s)


# Limits


FIGURES = Figures(
    duration_s=1.0,
    z_track=0.004,
    u_total=None,
    max_error_deg=4.0,
    final_error_deg=0.5,
    measurement=Stream(frames_per_s=500, bits_per_s=1),
    command=Stream(frames_per_s=500, bits_per_s=1),
    skipped_ticks=2,
    latency_us=None,
    log=None,
    trips=["tilted"],
)


@pytest.mark.parametrize(
    ("limit", "why"),
    [
        ("z_track=40e-4", None),
        ("z_track=39e-4", "z_track is 0.004, more than 0.0039"),
        ("skipped_ticks=2", None),
        ("skipped_ticks=1", "skipped_ticks is 2, more than 1"),
        ("trips=0", "trips is 1, more than 0"),
        ("u_total=1e9", "u_total is not known"),
        ("latency_us.p99=1e9", "latency_us.p99 is not known"),
    ],
)
def test_a_figure_is_held_to_its_limit_and_what_is_not_known_does_not_hold(limit: str, why: str | None) -> None:
    broken = Limit.parse(limit).broken(FIGURES)
    assert broken is None if why is None else broken is not None and why in broken


@pytest.mark.parametrize("text", ["", "z_track", "z_track=", "z_track=x", "speed=1", "=1"])
def test_what_is_no_limit_is_told_in_one_line(text: str) -> None:
    with pytest.raises(LimitError) as refused:
        Limit.parse(text)
    assert len(str(refused.value).splitlines()) == 1
