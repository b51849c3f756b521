"""`aeroloop log compare`: separate runs, named differences, limits per run, the page of `--html`."""

from __future__ import annotations

from json import loads
from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import load
from aeroloop.service.review.compare import Comparison, read_runs
from tests.support.made_log import make_log


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two runs that differ in a gain, and in where their logs are."""
    folder = tmp_path_factory.mktemp("logs")
    for name, gain in (("calm", "0.15"), ("keen", "0.3")):
        mine = [f"recorder.path={name}", f"network.rendezvous=tcp/127.0.0.1:{len(name)}"]
        settings = load(overrides=["loop.lockstep=true", f"law.C2=[{gain}, {gain}, {gain}]", *mine])
        make_log(folder / f"{name}.mcap", 100, settings=settings)
    return str(folder / "calm.mcap"), str(folder / "keen.mcap")


def test_logs_are_compared_in_the_terminal_as_json_and_on_a_page(
    logs: tuple[str, str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    assert run(("log", "compare", *logs, "--html", str(out))) == 0
    printed = capfd.readouterr().out
    assert "law.C2" in printed
    assert "[0.3, 0.3, 0.3]" in printed
    assert "2 runs compared" in out.read_text()
    assert list(tmp_path.iterdir()) == [out]
    assert run(("log", "compare", *logs, "--json")) == 0
    compared = loads(capfd.readouterr().out)
    values = {"calm": [0.15] * 3, "keen": [0.3] * 3}
    assert compared["differences"] == [{"key": "law.C2", "values": values}]
    assert compared["runs"]["calm"]["z_track"] != compared["runs"]["keen"]["z_track"]


def test_a_limit_holds_only_if_it_holds_for_every_run(logs: tuple[str, str], capfd: pytest.CaptureFixture[str]) -> None:
    assert run(("log", "compare", *logs, "--require", "duration_s=0.2")) == 0
    assert run(("log", "compare", *logs, "--require", "duration_s=0.1")) == 1
    assert capfd.readouterr().err.splitlines()[-1].count("duration_s ≤ 0.1") == 2
    assert run(("log", "compare", logs[0])) == 2
    assert capfd.readouterr().err == "aeroloop: log compare takes two logs or more\n"


def test_logs_of_one_name_are_named_with_their_folders_or_by_number(logs: tuple[str, str], tmp_path: Path) -> None:
    for folder, log in zip(("before", "after"), logs, strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "log.mcap").write_bytes(Path(log).read_bytes())
    named = read_runs([tmp_path / "before/log.mcap", tmp_path / "after/log.mcap", tmp_path / "after/log.mcap"])
    assert [run.name for run in named] == ["before/log", "after/log", "after/log (2)"]
    assert list(Comparison.of(named).runs) == [run.name for run in named]
