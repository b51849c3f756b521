"""A log that most tests of the review read."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.service.config import load
from tests.support.made_log import make_log

TICKS = 500


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 500 ticks in real time, each answered after 300 µs."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    make_log(path, TICKS, settings=load())
    return path
