"""A role's process: what must be set before it joins the network."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from unittest.mock import Mock

import pytest

from aeroloop.protocol.runtime import node, realtime
from aeroloop.protocol.transport.zenoh_config import THREADS
from aeroloop.service.cli.common import DaemonOptions, run_role
from aeroloop.service.config import load


def test_zenoh_gets_several_threads_in_a_daemon_unless_the_user_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """One slow peer then blocks one of them. A library call sets nothing: the variable is the user's there."""
    threads: list[str | None] = []

    def joins(*_: object) -> AbstractContextManager[Mock]:
        threads.append(os.environ.get("ZENOH_RUNTIME"))
        return nullcontext(Mock())

    monkeypatch.setattr(node, "Node", joins)
    monkeypatch.setattr(realtime, "no_linger", lambda: None)  # it would filter the tests' own system calls
    for configured, used in ((None, THREADS), ("(rx: (worker_threads: 2))", "(rx: (worker_threads: 2))")):
        monkeypatch.delenv("ZENOH_RUNTIME", raising=False)
        if configured is not None:
            monkeypatch.setenv("ZENOH_RUNTIME", configured)
        run_role("plant", load(), lambda _: None, DaemonOptions())
        assert threads[-1] == used
