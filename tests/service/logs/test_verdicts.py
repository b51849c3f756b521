"""A verdict names in its own line what it did not see: ticks that are missing, files that are cut or damaged."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from aeroloop.protocol.messages.trace import read_batch
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.report.page import page
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read
from tests.support.edited_log import Said, chunks, rewrite, with_a_damaged_chunk
from tests.support.made_log import lockstep, make_log

TICKS = 600


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=lockstep(), chunk_every=2)
    return path


def cut(whole: Path, out: Path) -> Path:
    """As a recorder leaves it that is killed: cut within a chunk."""
    data = whole.read_bytes()
    chunk = chunks(data)[-4]
    out.write_bytes(data[: (chunk.offset + chunk.end) // 2])
    return out


def begun_late(whole: Path, out: Path) -> Path:
    """Without the plant's first rows: it ran before the recorder came."""

    def late(one: Said) -> Said | None:
        batch = read_batch(one.data) if one.key.endswith("trace/plant") else None
        return one if batch is None or batch.header.first_row else None

    return rewrite(whole, out, late)


def unfinished(whole: Path, out: Path) -> Path:
    """The session went on when the recorder ended: no batch is the last."""
    return rewrite(
        whole,
        out,
        lambda one: one._replace(data=one.data[:2] + b"\0" + one.data[3:]) if one.topic == "trace" else one,
    )


def of_a_real_plant(_: Path, out: Path) -> Path:
    make_log(out, 100, settings=load(overrides=["loop.lockstep=true", "plant.via=quanser"]))
    return out


@pytest.fixture
def damaged(whole: Path, tmp_path: Path) -> Path:
    """With a chunk that cannot be read, with ticks of both ends."""
    return with_a_damaged_chunk(whole, tmp_path / "damaged.mcap")


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

SAME = rf"^{TICKS} ticks, every tick is the same, byte for byte$"
PARTLY = r"^the same, byte for byte, at \d+ ticks; not compared: "
CUT = PARTLY + r".*: the file is cut within a record of \d+ bytes \(byte \d+, after [-\d]+ [:\d]+ UTC\)"
LACKS = PARTLY + r"\d+ of the {end}'s ticks in s1, ticks \d+ to \d+, which the log lacks; "
LAST = rf"not in the log: the last of the {{end}}'s ticks, from tick {TICKS} of s1 on"


@pytest.mark.parametrize(
    ("edit", "options", "code", "controller", "plant"),
    [
        (lambda whole, _: whole, (), 0, SAME, SAME),
        (cut, (), 1, CUT, CUT),
        # The controller goes on after the gap, the plant ends at it.
        (with_a_damaged_chunk, (), 1, LACKS + ".*: a chunk", LACKS + r"\d+ of the plant's rows: \d+ rows are missing"),
        (begun_late, (), 1, SAME, "^not replayed: the log lacks the plant's first row"),
        (begun_late, ("--end", "controller"), 0, SAME, None),
        (of_a_real_plant, (), 0, "every tick is the same", "'quanser': only an emulated plant is computed again"),
        (unfinished, (), 0, LAST, LAST),
    ],
)
def test_a_replay_names_what_it_did_not_compare_and_fails_where_ticks_are_missing(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    edit: Callable[[Path, Path], Path], options: tuple[str, ...], code: int, controller: str, plant: str | None,
) -> None:  # fmt: skip
    log = edit(whole, tmp_path / "a.mcap")
    verdict = Verdict(capsys, "replay", log, *options)
    assert verdict.code == code
    for end, says in (("controller", controller), ("plant", plant)):
        assert says is None or re.search(says.format(end=end), verdict.line(end))
    if not options:
        found = json.loads(Verdict(capsys, "replay", log, "--json").out)
        assert found["missing"] == [gap.model_dump() for gap in read(log).findings.missing]
        assert set(found["damages"]) <= set(found["unseen"]["plant"])


# Requirements


def test_a_requirement_that_seems_met_fails_where_something_is_missing_unless_that_is_permitted(
    damaged: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Verdict(capsys, "review", whole, "--require", "skipped_ticks=0").code == 0
    found = read(damaged).findings
    missing, met = sum(found.missing_ticks.values()), ("review", damaged, "--require", "z_track=1", "--require")
    verdict = Verdict(capsys, *met[:-1])
    assert verdict.code == 1
    assert re.match(r"aeroloop: z_track ≤ 1 s does not hold: 0\.\d+ s, but not seen: ", verdict.err)
    assert all(str(gap) in verdict.err for gap in found.missing)
    assert f"{damaged}: a chunk" in verdict.err
    assert f"--require missing_ticks={missing} --require damages=1 permits it" in verdict.err
    assert "✗ z_track ≤ 1 s" in verdict.out
    assert "a chunk" in Verdict(capsys, *met, f"missing_ticks={missing}").err
    assert Verdict(capsys, *met, f"missing_ticks={missing}", "--require", "damages=1").code == 0
    assert Verdict(capsys, *met, f"missing_ticks={missing - 1}", "--require", "damages=1").code == 1
    compared = Verdict(capsys, "compare", whole, damaged, "--require", "z_track=1")
    assert (compared.code, "damaged: z_track ≤ 1 s does not hold" in compared.err) == (1, True)
    assert "but not seen: " in page([read(damaged).report([Limit.parse("z_track=1")])])
    killed = cut(whole, damaged.with_name("cut.mcap"))
    assert Verdict(capsys, "review", killed, "--require", "z_track=1").code == 1
