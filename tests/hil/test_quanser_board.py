"""Conformance suite against the driver of Quanser's board, as a process that imports the fake for Quanser's package."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from aeroloop.service.testing.conformance.test_plant_end import *  # noqa: F403  # the suite

SDK = Path(__file__).parents[1] / "support" / "quanser_sdk"


@pytest.fixture(scope="module", autouse=True)
def fake_package() -> Iterator[None]:
    """Let processes find the fake where Quanser's package would be: they import from where this process does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SDK)
        yield


@pytest.fixture
def hil_plant() -> str:
    return "quanser"
