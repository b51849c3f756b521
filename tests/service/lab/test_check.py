"""A change is judged by logs: what differs is named, what is accepted is expected from then on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aeroloop.protocol.errors import ConfigError
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.lab.check import check_log, check_logs, logs_of
from aeroloop.service.logs.recording import ReviewError
from tests.support.made_log import lockstep, make_log

TICKS = 400
MORE_DAMPING = "law.C2=[0.2,0.2,0.2]"


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    make_log(folder / "a.mcap", TICKS, settings=lockstep())
    make_log(folder / "b.mcap", TICKS, settings=load())
    return folder


def test_logs_of_this_code_are_equal_and_their_loops_run_again(corpus: Path) -> None:
    first, second = check_logs([corpus])
    for one in (first, second):
        assert (one.same, one.commands, one.differ, one.plant_ticks, one.plant_differ) == (True, TICKS, 0, TICKS, 0)
        assert (one.first, one.notes, one.error) == ([], [], None)
        assert one.before is not None
        assert one.after is not None
        assert one.before.z_track == one.after.z_track  # made without a lost or late frame


def test_a_change_is_named_by_its_first_tick_its_signal_both_values_and_steps(corpus: Path) -> None:
    one = check_log([corpus / "a.mcap"], [MORE_DAMPING])
    assert not one.same
    assert 0 < one.differ < TICKS
    assert one.first == ["s1 at tick 0 (0 s), logged and computed: voltage_2 3.80952 and 4.57143 V, 1 step apart"]
    assert one.before is not None
    assert one.after is not None
    assert one.after.z_track != one.before.z_track
    other = check_log([corpus / "a.mcap"], ["wire.attitude.bits=10"])
    assert not other.same
    assert other.first == ["its measurements are frames of another wire, so no command can be computed from them"]
    assert other.after is not None
    assert other.after.z_track != one.before.z_track
    heavier = check_log([corpus / "a.mcap"], ["plant.aero.mass=1.3"])  # on the recorded measurements all is the same
    assert heavier.same
    assert heavier.after is not None
    assert heavier.after.z_track != one.before.z_track


def test_what_is_accepted_is_expected_and_anything_else_is_not(tmp_path: Path) -> None:
    make_log(log := tmp_path / "a.mcap", TICKS)
    words = ["log", "check", str(log), "--json", "--set"]
    assert execute([*words, MORE_DAMPING]) == 1
    assert execute([*words, MORE_DAMPING, "--accept"]) == 0
    assert json.loads((tmp_path / "a.accepted.json").read_text())["differ"] > 0
    assert execute([*words, MORE_DAMPING]) == 0
    assert execute([*words, "law.C2=[0.21,0.21,0.21]"]) == 1
    assert execute(words[:-1]) == 0  # equal needs no acceptance
    (tmp_path / "a.accepted.json").write_text("{}")
    assert execute([*words, MORE_DAMPING]) == 1


def test_the_table_goes_into_a_pull_request(corpus: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "table.md"
    assert execute(["log", "check", str(corpus), "--law", "pid", "--markdown", str(out)]) == 1
    head, _, *found = out.read_text().split("\n\n")[0].splitlines()
    assert head.startswith("|  | log | commands | plant | first difference | z_track ×10⁻⁴ s | u_total V²·s | max")
    assert [row.split(" | ")[:2] for row in found] == [["| ✗", "a.mcap"], ["| ✗", "b.mcap"]]
    assert "✗  a.mcap" in capfd.readouterr().out


def test_a_log_that_cannot_be_read_is_a_row_and_a_wrong_override_is_an_error(corpus: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_text("hello")
    (tmp_path / "empty").mkdir()
    for overrides in ([], [MORE_DAMPING]):
        (one,) = check_logs([tmp_path], overrides)
        assert not one.same
        assert one.error is not None
        assert "broken.mcap does not begin as an MCAP file" in one.error
    with pytest.raises(ConfigError, match=r"unknown key law.C9"):
        check_logs([corpus], {"law.C9": 1})
    with pytest.raises(ReviewError, match=r"there is no \.mcap file in"):
        check_logs([tmp_path / "empty"])


def test_files_of_a_rotated_run_are_one_log(tmp_path: Path) -> None:
    names = ("a.mcap", "a-0001.mcap", "a-0002.mcap", "b.mcap", "b-decoded.mcap")
    for name in names:
        (tmp_path / name).touch()
    assert [[file.name for file in log] for log in logs_of([tmp_path])] == [
        ["a.mcap", "a-0001.mcap", "a-0002.mcap"],
        ["b.mcap"],
    ]
