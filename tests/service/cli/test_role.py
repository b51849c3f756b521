"""A role's process: what must be done before it joins the network."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from unittest.mock import Mock

import pytest

from aeroloop.protocol.runtime import realtime, role
from aeroloop.service.cli.common import DaemonOptions, run_role
from aeroloop.service.config import load


def test_a_role_shares_one_heap_before_its_session_starts_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []

    def joins(*_: object) -> AbstractContextManager[Mock]:
        called.append("joins")
        return nullcontext(Mock())

    monkeypatch.setattr(realtime, "share_heap", lambda: called.append("shares its heap"))
    monkeypatch.setattr(role, "Role", joins)
    run_role("plant", load(), lambda _: called.append("runs"), DaemonOptions())
    assert called == ["shares its heap", "joins", "runs"]
