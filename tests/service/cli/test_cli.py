"""Command line: wrong usage gives one line with a remedy, and an exit code; help needs no mathematics."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.cli.main import app, execute


def refusal(capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and the one line on stderr."""
    code = execute(arguments)
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("aeroloop: ")
    return code, lines[0]


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("lab experiment --set wire.rate.bitz=3", "did you mean wire.rate.bits?"),
        ("lab experiment --set wire.rate.bits=17", "wire.rate.bits"),
        ("lab experiment --set nonsense", "nonsense"),
        ("lab experiment --bits 1/6", "--bits: "),
        ("lab experiment --config no/such.toml", "no/such.toml"),
        ("lab experiment --speed 9", "--speed"),
        ("lab experiment --set law.kind=none", "law.kind = 'none' is not known"),
        ("lab experiment --set plant.kind=none", "plant.kind = 'none' is not known"),
        ("op stpo", "Did you mean 'stop'?"),
        ("stop", "No such command 'stop'"),
        ("demo --set vehicle=a/b", "vehicle"),
        ("demo --duration 0", "greater than or equal to 0.01"),
        ("op set-gains --C1 1 2 --json", "give each gain as --NAME and its numbers, such as --C2 0.2 0.2 0.2"),
        ("op track configured --amplitude 1 2 3", "configured takes no option but --in"),
        ("op inject", "name a fault, such as rate:off@1..2, or give --clear"),
        ("op inject motors:bias=1e308", "bias takes -48 to 48 V, not 1e+308"),
        ("log export a.mcap --format foo", "'foo' is not one of 'parquet', "),
        ("log export a.mcap --out a.xlsx", "--format, or --out FILE.parquet, FILE.csv or FILE.mcap"),
        ("log export a.mcap", "--format, or --out FILE.parquet, FILE.csv or FILE.mcap"),
        ("log step a.mcap --when 3", "No such option: --when (see `aeroloop log step --help`)"),
        ("lab sweep --duraton 3", "No such option: --duraton: did you mean --duration? (see"),
        ("op track sinusiod", "sinusiod is neither a reference nor a file: did you mean sinusoid?"),
        ("op track points.csv", "cannot read points.csv"),
        ("log review a.mcap --from 3 --to 2", "--from 3 is not before --to 2"),
        ("log step a.mcap --at noon", "--at is a time such as 12.34, or a tick such as tick:6170, not noon"),
        ("log step a.mcap --at tick", "a tick such as tick:6170, not tick"),
        ("log step a.mcap --at tick:1:2", "a tick such as tick:6170, not tick:1:2"),
        ("log fork a.mcap --at nan", "--at is a time such as 12.34, or a tick such as tick:6170, not nan"),
        ("log review a.mcap --speed", "see `aeroloop log review --help`"),
        ('demo --set plant.faults=["rate:x"]', "drop, garble, not "),
    ],
)
def test_wrong_usage_and_configuration_exit_with_2_and_name_the_culprit(
    capfd: pytest.CaptureFixture[str], words: str, names: str
) -> None:
    code, line = refusal(capfd, *words.split())
    assert code == 2
    assert names in line
    if hint := re.search(r"see `aeroloop(.*)`", line):
        assert execute(hint[1].split()) == 0


def test_what_cannot_be_done_exits_with_1_and_is_named(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("hello")
    alone = ("--set", "network.rendezvous=")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        for words, named in (
            (("log", "review", f"{tmp_path}/file"), f"{tmp_path}/file"),
            (("log", "review", f"{tmp_path}/none.mcap"), "none.mcap"),
            (("recorder", "--log", f"{tmp_path}/file/a.mcap", *alone), "a.mcap"),
            (("op", "metrics", "--port", endpoint.rpartition(":")[2], *alone), endpoint.removeprefix("tcp/")),
            (("recorder", "--log", str(tmp_path), *alone, "--set", f'network.listen=["{endpoint}"]'), endpoint),
        ):
            code, line = refusal(capfd, *words)
            assert (code, named in line) == (1, True)


def test_a_run_that_does_not_fit_into_memory_is_refused_before_it_begins(capfd: pytest.CaptureFixture[str]) -> None:
    code, line = refusal(capfd, "lab", "experiment", "--duration", "1e9")
    assert code == 1
    assert "a run of 1e+09 s at 500 Hz does not fit into this machine's memory: " in line


def test_experiment_prints_the_designs_names_as_json(capfd: pytest.CaptureFixture[str]) -> None:
    assert execute(["lab", "experiment", "--duration", "0.1", "--json"]) == 0
    figures = json.loads(capfd.readouterr().out)
    names = "z_track u_total max_error_deg final_error_deg measurement command skipped_ticks latency_us log"
    assert set(figures) >= set(names.split())
    assert figures["measurement"] == {"frames_per_s": 500.0, "bits_per_s": 28000.0}
    assert all(figures[name] is None and figures["reasons"][name] for name in ("latency_us", "log"))


def test_every_verb_has_help_and_is_listed_with_a_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    groups = {each.name: each.typer_instance for each in app.registered_groups if each.typer_instance}
    for name, group in groups.items():
        words = [str(name)] if name else []
        assert execute([*words, "-h"]) == 0
        listed = capfd.readouterr().out
        for verb in group.registered_commands:
            called = str(verb.name or getattr(verb.callback, "__name__", ""))
            assert re.search(rf"^  {called} +[A-Z].+[^.]\.$", listed, re.MULTILINE), called  # whole in 80 columns
            assert execute([*words, called, "--help"]) == 0
            assert "Usage: aeroloop" in capfd.readouterr().out
    assert execute(["op"]) == 2
    assert "Stop the vehicle's plant at once" in capfd.readouterr().err


@pytest.mark.parametrize("words", [("--help",), ("op", "stop", "--help"), ("op", "stop")])
def test_help_and_an_operators_stop_wait_for_no_mathematics(words: tuple[str, ...]) -> None:
    program = "import sys; from aeroloop.service.cli.entry import main\ntry: main()\nfinally: print(*sys.modules)"
    command = [sys.executable, "-P", "-c", program, *words, *(["--set", "network.rendezvous=[]"] * (len(words) == 2))]
    printed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    imported = set(printed.splitlines()[-1].split())
    assert "aeroloop.service.cli.op" in imported
    assert not imported & {"casadi", "scipy", "mcap", "matplotlib", "plotly", "aeroloop.service.config"}
