"""Start of a command: it imports what its verb needs, reads no other package's metadata, and starts no BLAS threads."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from aeroloop.service.cli.entry import SWITCHES

_PROGRAM = """
import importlib.metadata, os, sys
importlib.metadata.entry_points = lambda **_: os._exit(99)
from aeroloop.service.cli.entry import main
try:
    main()
finally:
    print(len(os.listdir("/proc/self/task")), *sys.modules, file=sys.stderr)
"""


def run(*words: str) -> tuple[int, set[str]]:
    """Threads and imported modules at the end of a command."""
    environment = {name: os.environ[name] for name in os.environ.keys() - SWITCHES}
    command = [sys.executable, "-P", "-c", _PROGRAM, *words]
    process = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert process.returncode != 99, "it reads the metadata of every installed package"
    threads, *modules = process.stderr.splitlines()[-1].split()
    return int(threads), set(modules)


MATHEMATICS = {"numpy", "casadi"}
TABLES = {"rich"}
PAGES = {"rich.markdown", "matplotlib", "plotly", "pyarrow", "scipy", "mcap"}
CONFIGURATION = {"aeroloop.service.config", "aeroloop.plant_emulator"}
MODELS = {"pydantic", "pydantic_core", "zenoh", "aeroloop.protocol.messages.models"}
NO_NETWORK = ("--set", "network.rendezvous=[]")


def groups_but(used: str) -> set[str]:
    """Modules of verbs other than those of one group."""
    return {f"aeroloop.service.cli.{name}" for name in ("run", "lab", "log", "op", "host", "show") if name != used}


@pytest.mark.parametrize(
    ("words", "unused"),
    [
        (("--help",), MATHEMATICS | PAGES | CONFIGURATION | MODELS | groups_but("run")),
        (("op", "--help"), MATHEMATICS | PAGES | CONFIGURATION | MODELS | groups_but("op")),
        (("lab", "certify", "--help"), MATHEMATICS | PAGES | CONFIGURATION | MODELS | groups_but("lab")),
        (("op", "stop", *NO_NETWORK), PAGES | CONFIGURATION | TABLES | groups_but("op")),
        (("op", "status", *NO_NETWORK), PAGES | CONFIGURATION | TABLES | groups_but("op")),
        (("show", "config"), PAGES | TABLES),
        (("recorder", "--log", "/dev/null/no.mcap", *NO_NETWORK), TABLES | PAGES - {"mcap"}),
        (("lab", "experiment", "--duration", "0.02"), PAGES),
    ],
)
def test_a_command_imports_nothing_that_its_verb_does_not_need(words: tuple[str, ...], unused: set[str]) -> None:
    _, imported = run(*words)
    assert "aeroloop.service.cli.main" in imported
    assert not imported & unused


def test_an_experiment_starts_no_threads() -> None:
    threads, imported = run("lab", "experiment", "--duration", "0.02")
    assert (threads, "numpy" in imported) == (1, True)
