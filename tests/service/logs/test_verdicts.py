"""A verdict names in its own line what it did not see: ticks that are missing, files that are cut or damaged."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aeroloop.protocol.messages.trace import read_batch
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.report.page import page
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read, report
from tests.support.edited_log import Said, rewrite
from tests.support.made_log import SESSION, lockstep, make_log
from tests.support.mcap_parts import chunks, with_a_damaged_chunk

TICKS = 600


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=lockstep(), chunk_every=2)
    return path


@pytest.fixture
def cut(whole: Path, tmp_path: Path) -> Path:
    """As a recorder leaves it that is killed: cut within a chunk."""
    data = whole.read_bytes()
    chunk = chunks(data)[-4]
    (tmp_path / "cut.mcap").write_bytes(data[: (chunk.offset + chunk.end) // 2])
    return tmp_path / "cut.mcap"


@pytest.fixture
def damaged(whole: Path, tmp_path: Path) -> Path:
    """With a chunk that cannot be read, with ticks of both ends."""
    return with_a_damaged_chunk(whole, tmp_path / "damaged.mcap")


def without(end: str, gone: Callable[[Any], bool]) -> Callable[[Said], Said | None]:
    """What drops an end's batches of which this holds."""
    return lambda one: None if one.key.endswith(f"trace/{end}") and gone(read_batch(one.data)) else one


class Verdict:
    """What a command of `log` prints and exits with."""

    def __init__(self, capsys: pytest.CaptureFixture[str], *words: object) -> None:
        self.code = execute(["log", *map(str, words)])
        printed = capsys.readouterr()
        self.out, self.err = " ".join(printed.out.split()), printed.err

    def line(self, end: str) -> str:
        """The verdict on an end, to the next one's."""
        found = re.search(rf"\b{end}: (?!first differs)(.*?)(?= (?:plant|not read): |$)", self.out)
        assert found, self.out
        return found[1]


# Replay


def test_of_a_whole_log_every_tick_is_the_same(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verdict = Verdict(capsys, "replay", whole)
    assert verdict.code == 0
    assert (
        verdict.line("controller") == verdict.line("plant") == f"{TICKS} ticks, every tick is the same, byte for byte"
    )


def test_a_replay_of_a_cut_log_names_the_cut_and_fails(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verdict = Verdict(capsys, "replay", cut)
    assert verdict.code == 1
    for end in ("controller", "plant"):
        assert re.match(r"the same, byte for byte, at \d+ ticks; not compared: ", verdict.line(end))
        assert re.search(
            rf"{cut}: the file is cut within a record of \d+ bytes \(byte \d+, after [-\d]+ [:\d]+ UTC\)",
            verdict.line(end),
        )
    assert "every tick" not in verdict.out
    found = json.loads(Verdict(capsys, "replay", cut, "--json").out)
    assert found["controller"]["ticks"] < TICKS
    assert found["damages"] == [line for line in found["unseen"]["plant"] if str(cut) in line]
    assert {gap["session"] for gap in found["missing"]} == {SESSION}


def test_a_replay_of_a_damaged_log_names_the_ticks_that_it_lacks_and_fails(
    damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The controller goes on after the gap, the plant ends at it; the rows after it are named, too."""
    verdict, findings = Verdict(capsys, "replay", damaged), read(damaged).findings
    assert verdict.code == 1
    gap, other = sorted(findings.missing, key=lambda one: one.end)
    assert (gap.end, other.end) == ("controller", "plant")
    same = f"the same, byte for byte, at {TICKS - gap.rows} ticks; not compared: "
    assert verdict.line("controller").startswith(f"{same}{gap}, which the log lacks; {damaged}: a chunk")
    assert other.last_tick is not None
    left = f"{TICKS - other.last_tick - 1} of the plant's rows: {other.rows} rows are missing"
    assert f"{other}, which the log lacks; {left}" in verdict.line("plant")
    found = json.loads(Verdict(capsys, "replay", damaged, "--json").out)
    assert found["missing"] == [gap.model_dump() for gap in findings.missing]


def test_rows_of_a_plant_that_ran_before_the_recorder_came_are_named_and_fail_unless_only_the_controller_is_asked_for(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rewrite(whole, tmp_path / "a.mcap", without("plant", lambda batch: batch.header.first_row == 0))
    verdict = Verdict(capsys, "replay", path)
    assert verdict.code == 1
    assert "not replayed: the log lacks the plant's first row" in verdict.line("plant")
    unseen = json.loads(Verdict(capsys, "replay", path, "--json").out)["unseen"]["plant"]
    assert any("of the plant's rows: the log lacks the plant's first row" in line for line in unseen)
    alone = Verdict(capsys, "replay", path, "--end", "controller")
    assert alone.code == 0
    assert alone.line("controller") == f"{TICKS} ticks, every tick is the same, byte for byte"


def test_a_plant_that_cannot_be_computed_again_costs_no_exit_code_and_has_its_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_log(tmp_path / "a.mcap", 100, settings=load(overrides=["loop.lockstep=true", "plant.via=quanser"]))
    verdict = Verdict(capsys, "replay", tmp_path / "a.mcap")
    assert verdict.code == 0
    assert "'quanser': only an emulated plant is computed again" in verdict.line("plant")


def test_a_session_that_went_on_when_the_recorder_ended_is_named_and_costs_no_exit_code(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def unfinished(one: Said) -> Said:
        return one._replace(data=one.data[:2] + b"\0" + one.data[3:]) if one.topic == "trace" else one

    verdict = Verdict(capsys, "replay", rewrite(whole, tmp_path / "a.mcap", unfinished))
    assert verdict.code == 0
    for end in ("controller", "plant"):
        assert f"not in the log: the last of the {end}'s ticks, from tick {TICKS} of s1 on" in verdict.line(end)


# Requirements


def test_a_requirement_that_seems_met_fails_where_ticks_are_missing_or_a_file_is_damaged(
    damaged: Path, cut: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Verdict(capsys, "review", whole, "--require", "skipped=0").code == 0
    missing = sum(read(damaged).findings.missing_ticks.values())
    verdict = Verdict(capsys, "review", damaged, "--require", "z_track=1")
    assert verdict.code == 1
    assert re.match(r"aeroloop: z_track ≤ 1 s does not hold: 0\.\d+ s, but not seen: ", verdict.err)
    assert all(str(gap) in verdict.err for gap in read(damaged).findings.missing)
    assert f"{damaged}: a chunk" in verdict.err
    assert f"--require missing_ticks={missing} --require damages=1 permits it" in verdict.err
    assert "✗ z_track ≤ 1 s" in verdict.out
    assert Verdict(capsys, "review", cut, "--require", "z_track=1").code == 1


def test_what_is_explicitly_permitted_to_be_missing_fails_no_requirement(
    damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = sum(read(damaged).findings.missing_ticks.values())
    limits = ["--require", "z_track=1", "--require", f"missing_ticks={missing}"]
    assert "a chunk" in Verdict(capsys, "review", damaged, *limits).err
    assert Verdict(capsys, "review", damaged, *limits, "--require", "damages=1").code == 0
    fewer = ["--require", "z_track=1", "--require", f"missing_ticks={missing - 1}", "--require", "damages=1"]
    assert Verdict(capsys, "review", damaged, *fewer).code == 1


def test_a_comparison_and_a_page_say_it_too(damaged: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verdict = Verdict(capsys, "compare", whole, damaged, "--require", "z_track=1")
    assert verdict.code == 1
    assert verdict.err.startswith("aeroloop: damaged: z_track ≤ 1 s does not hold: 0.")
    assert "but not seen: " in verdict.err
    html = page([report([damaged], [Limit.parse("z_track=1")])])
    assert "1 of 1 limit broken" in html
    assert "but not seen: " in html
