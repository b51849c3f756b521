"""The pytest plugin: a `hil` fixture for tests of one's own, on real processes.

It is there once the package is installed. What it needs is imported by the first test that asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from service.hil import Hil


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the `hil` fixture."""
    group = parser.getgroup("aeroloop", "hardware in the loop, with aeroloop")
    group.addoption(
        "--hil-plant",
        choices=["emulator", "can", "quanser"],
        default="emulator",
        help="what stands at the plant end of `hil`",
    )
    group.addoption(
        "--hil-lockstep", action="store_true", help="run `hil` in lockstep: repeatable, and as fast as it goes"
    )


@pytest.fixture
def hil(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Hil]:
    """A loop of real processes: start it, run it, let things go wrong, and ask its log."""
    from service.hil import Hil

    with Hil(tmp_path, lockstep=request.config.getoption("--hil-lockstep")) as loop:
        yield loop
