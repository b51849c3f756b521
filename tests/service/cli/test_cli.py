"""Command line: wrong usage gives one line with a remedy, and an exit code."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from aeroloop.service.cli.main import execute as run
from aeroloop.service.cli.main import root
from aeroloop.service.config import load


def refusal(capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and the one line on stderr."""
    code = run(arguments)
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("aeroloop: ")
    return code, lines[0]


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("lab", "experiment", "--set", "wire.rate.bitz=3"), "wire.rate.bitz"),
        (("lab", "experiment", "--set", "wires=3"), "wires"),
        (("lab", "experiment", "--set", "wire.rate.bits=17"), "wire.rate.bits"),
        (("lab", "experiment", "--set", "law.C2=[0.1, 0.1, -1]"), "law.C2"),
        (("lab", "experiment", "--set", "nonsense"), "nonsense"),
        (("lab", "experiment", "--bits-out", "1"), "--bits-out"),
        (("lab", "experiment", "--bits-in", "many"), "--bits-in"),
        (("lab", "experiment", "--config", "no/such.toml"), "no/such.toml"),
        (("lab", "experiment", "--duration", "0"), "--duration"),
        (("lab", "experiment", "--speed", "9"), "--speed"),
        (("lab", "fly"), "fly"),
        (("stop",), "did you mean `aeroloop op stop`?"),
        (("op", "stpo"), "did you mean `aeroloop op stop`?"),
        (("lab", "replay"), "did you mean `aeroloop log replay`?"),
        (("emulatr",), "did you mean `aeroloop emulator`?"),
        (("demo", "--set", "vehicle=a/b"), "vehicle"),
        (("demo", "--duration", "x"), "--duration must be a number, not 'x' ("),
        (("demo", "--duration", "0"), "--duration must be at least 0.01, not '0' ("),
        (
            ("op", "set-gains", "--C1", "1", "2", "--json"),
            "give each gain as --NAME and its numbers, such as --C2 0.2 0.2 0.2",
        ),
        (("log", "export", "a.mcap", "--to", "foo"), "--to: 'foo' is not one of 'parquet', "),
        (("demo", "--durat", "3"), "did you mean --duration? ("),
        (("log", "review", "a.mcap", "--session"), "see `aeroloop log review --help`"),
        (("demo", "--set", 'plant.faults=["rate:x"]'), "drop and garble, not "),
    ],
)
def test_wrong_usage_and_configuration_exit_with_2_and_name_the_culprit(
    capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...], names: str
) -> None:
    code, line = refusal(capfd, *arguments)
    assert code == 2
    assert names in f"{line}\n"
    if hint := re.search(r"see `aeroloop(.*)`", line):
        assert run(hint[1].split()) == 0


def test_a_broken_configuration_file_is_named(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[wire\n")
    code, line = refusal(capfd, "show", "config", "--config", str(path))
    assert code == 2
    assert str(path) in line


def test_a_log_that_is_not_one_exits_with_1(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("hello")
    code, line = refusal(capfd, "log", "review", str(path))
    assert code == 1
    assert str(path) in line
    code, line = refusal(capfd, "log", "review", str(tmp_path / "none.mcap"))
    assert code == 1
    assert "none.mcap" in line


def test_a_port_in_use_exits_with_1_and_is_named(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        network = ("--set", f'network.listen=["{endpoint}"]', "--set", "network.rendezvous=")
        code, line = refusal(capfd, "recorder", "--log", str(tmp_path / "a.mcap"), *network)
        assert code == 1
        assert endpoint in line


def test_a_log_that_cannot_be_written_exits_with_1(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, line = refusal(capfd, "recorder", "--log", str(tmp_path / "file" / "a.mcap"), "--set", "network.rendezvous=")
    assert code == 1
    assert "a.mcap" in line


def test_the_shown_configuration_read_back_is_the_same(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    overrides = ("--set", "wire.attitude.bits=cont", "--set", "loop.rate_hz=1000", "--set", "controller.stale_s=0.05")
    assert run(["show", "config", *overrides]) == 0
    path.write_text(capfd.readouterr().out)
    shown = load(path)
    assert shown.description() == load(overrides=[text for text in overrides if text != "--set"]).description()
    assert shown.wire.attitude.bits is None
    assert shown.description() != load().description()


def test_the_environment_overrides_the_file_and_set_overrides_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.toml"
    path.write_text("vehicle = 'file'\n[loop]\nrate_hz = 100.0\n")
    assert load(path).vehicle == "file"
    monkeypatch.setenv("AEROLOOP_VEHICLE", "environment")
    monkeypatch.setenv("AEROLOOP_LOOP__LOCKSTEP", "true")
    settings = load(path)
    assert (settings.vehicle, settings.loop.rate_hz, settings.loop.lockstep) == ("environment", 100.0, True)
    assert load(path, ["vehicle=option"]).vehicle == "option"


def test_experiment_prints_the_designs_names_as_json(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["lab", "experiment", "--duration", "0.1", "--json"]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert set(figures) >= {
        "z_track", "u_total", "max_error_deg", "final_error_deg", "measurement", "command", "skipped_ticks",
        "latency_us", "log",
    }  # fmt: skip
    assert figures["measurement"] == {"frames_per_s": 500.0, "bits_per_s": 28000.0}
    for name in ("latency_us", "log"):  # null, with the reason beside it
        assert figures[name] is None
        assert figures["reasons"][name]


def commands() -> list[list[str]]:
    """Every command, as the words that call it."""
    command: Any = root()
    verbs = [[name, verb] for name, group in command.commands.items() for verb in group.list_commands(None)]
    return [[], *([name] for name in command.list_commands(None)), *verbs]


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_h_is_help_everywhere_and_shows_no_type_beside_a_flag(
    words: list[str], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80" if words == ["lab", "certify"] else "60")  # which has a long option with a range
    assert run([*words, "-h"]) == 0
    short = capfd.readouterr().out
    assert run([*words, "--help"]) == 0
    assert capfd.readouterr().out == short
    assert "." in short
    assert "bool" not in short
    assert "…" not in short.replace("2…16", "").replace("…`", "")  # nothing is cut off


def test_a_terminal_that_lacks_characters_shows_question_marks_and_tables_stay_aligned() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "60"}
    command = [sys.executable, "-P", "-m", "aeroloop", "lab", "certify", "--help"]
    printed = subprocess.run(command, check=True, capture_output=True, encoding="ascii", env=environment).stdout
    framed = [line for line in printed.splitlines() if line.startswith(("|", "+"))]
    assert any("Bits of ? and ?" in line for line in framed)
    assert {len(line) for line in framed} == {60}


def test_shells_can_complete_verbs_and_options(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "shellingham.detect_shell", lambda *_: ("bash", "/bin/bash")
    )  # by its parent, which may be none
    with pytest.raises(SystemExit):
        run(["--show-completion"])
    assert capfd.readouterr().out
    for typed, completed in (("aeroloop op st", ["status", "stop"]), ("aeroloop op status --ch", ["--check"])):
        monkeypatch.setenv("_AEROLOOP_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", typed)
        monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
        with pytest.raises(SystemExit):
            run([])
        assert capfd.readouterr().out.split() == completed


def test_show_config_is_toml_that_names_every_section(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["show", "config"]) == 0
    sections = tomllib.loads(capfd.readouterr().out)
    assert {"loop", "wire", "reference", "law", "controller", "plant", "recorder", "network"} <= set(sections)
