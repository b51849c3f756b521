"""^C: no traceback at any moment, exit code 130, and no process left. SIGTERM: a daemon says why it ends.

Real processes, each in a session of its own that gets SIGINT as a terminal would send it. Nothing is timed: each test
waits for an event of the process, for at most `PATIENCE_S`, as a shared machine can be slow.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.processes import AEROLOOP, sessions
from tests.support.zenoh_network import eventually

pytestmark = pytest.mark.processes

PATIENCE_S = 60.0


def take_signals() -> None:
    """Ignore no signal, as a background job ignores SIGINT and one under nohup SIGHUP."""
    for one in (signal.SIGINT, signal.SIGHUP):
        signal.signal(one, signal.SIG_DFL)


def start(*command: str) -> subprocess.Popen[str]:
    out, err = subprocess.DEVNULL, subprocess.PIPE
    return subprocess.Popen(command, stdout=out, stderr=err, text=True, start_new_session=True, preexec_fn=take_signals)


@pytest.mark.parametrize(
    ("words", "module", "sent", "code", "said"),
    [
        ("lab experiment", "typer.main", signal.SIGINT, 130, []),
        ("lab experiment", "pydantic.main", signal.SIGINT, 130, []),
        ("lab experiment", "numpy", signal.SIGINT, 130, []),
        ("recorder", "typer.main", signal.SIGTERM, 0, ["aeroloop: ended by a signal before it had started"]),
    ],
)
def test_a_signal_during_an_import_leaves_no_traceback(
    words: str, module: str, sent: int, code: int, said: list[str]
) -> None:
    process = start(sys.executable, "-P", "-X", "importtime", "-m", "aeroloop", *words.split())
    assert process.stderr is not None
    while not (line := process.stderr.readline()).rstrip().endswith(f" {module}"):
        assert line, f"{module} was not imported"
    process.send_signal(sent)
    _, rest = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    assert [line for line in rest.splitlines() if not line.startswith("import time:")] == said


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP])
def test_a_daemon_that_is_terminated_while_zenoh_is_opened_ends_at_once_and_says_so(tmp_path: Path, how: int) -> None:
    """What it connects to accepts, and does not answer. SIGHUP: its terminal is closed."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        router = f"network.rendezvous=tcp/127.0.0.1:{silent.getsockname()[1]}"
        process = start(*AEROLOOP, "recorder", "--log", str(tmp_path), "--set", router, "--set", "network.mode=client")
        with silent.accept()[0]:
            process.send_signal(how)
            _, said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said) == (0, "aeroloop: ended by a signal before it had started\n")


TERMINATED_IN_WAIT = """
import os, signal, sys, threading
from aeroloop.service.cli.entry import run_alone

def trace(frame, event, _):
    if frame.f_code is threading.Condition.wait.__code__:  # the event's lock is held
        os.kill(os.getpid(), signal.SIGTERM)

def run(stop):
    sys.settrace(trace)
    stop.wait()

run_alone(run)
"""


def test_a_daemon_that_is_terminated_just_as_it_begins_to_wait_ends() -> None:
    process = start(sys.executable, "-P", "-c", TERMINATED_IN_WAIT)
    try:
        assert process.wait(timeout=10) == 0
    finally:
        process.kill()
        process.communicate()


WITH_A_DEFECT = """
import sys
from {module} import {owner}
from aeroloop.service.cli.entry import main

def defect(*_, **__):
    raise RuntimeError("a defect")

{owner}.{method} = defect
main()
"""


@pytest.mark.parametrize(
    ("verb", "module", "owner", "method"),
    [
        ("recorder", "aeroloop.protocol.transport.history", "RecoveringSubscriber", "take"),
        ("op console --port 0", "aeroloop.protocol.transport.history", "RecoveringSubscriber", "take"),
        ("log live --port 0", "aeroloop.protocol.transport.history", "RecoveringSubscriber", "take"),
        ("controller", "aeroloop.service.daemon.claim", "ClaimClient", "claim"),
        ("plant", "aeroloop.plant_emulator.hosts.zenoh_network", "ZenohNetwork", "take_inbox"),
        ("router", "aeroloop.protocol.runtime.node", "Node", "status"),
    ],
)
def test_an_exception_that_nobody_foresaw_ends_a_process_with_one_line_and_exit_code_1(
    tmp_path: Path, verb: str, module: str, owner: str, method: str
) -> None:
    """With its session: a Python process with an open one does not end, and did not heed SIGTERM either."""
    code = WITH_A_DEFECT.format(module=module, owner=owner, method=method)
    words = [*verb.split(), "--set", f"network.rendezvous={free_rendezvous()}"]
    if verb == "recorder":
        words += ["--log", str(tmp_path)]
    process = start(sys.executable, "-P", "-c", code, *words)
    try:
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 1
    assert said.splitlines()[-1] == "aeroloop: unexpected RuntimeError: a defect; `aeroloop --debug …` shows where"
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("words", "sent", "said"),
    [
        ("lab tables", signal.SIGINT, ""),
        ("lab tables", signal.SIGKILL, ""),
        pytest.param(
            "demo --log a.mcap",
            signal.SIGINT,
            "aeroloop: 50 s of the experiment in real time, three processes\n",
            marks=pytest.mark.realtime,
        ),
    ],
)
def test_worker_processes_end_with_their_parent_in_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, sent: int, said: str
) -> None:
    """^C reaches the whole group; SIGKILL the parent alone."""

    def left() -> int:
        return list(sessions().values()).count(process.pid)

    monkeypatch.chdir(tmp_path)
    process = start(*AEROLOOP, *words.split())
    eventually("a process, beside this one and multiprocessing's", lambda: left() > 2 or process.poll() is not None)
    if sent == signal.SIGINT:
        os.killpg(process.pid, sent)
    else:
        process.send_signal(sent)
    _, printed = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == (130 if sent == signal.SIGINT else -sent)
    assert printed == said or sent == signal.SIGKILL
    eventually("the end of all", lambda: left() == 0)
