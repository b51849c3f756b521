"""Pytest plugin: provides the `hil` fixture, a closed loop of real processes.

Active once the package is installed. It imports the loop's modules only when a test uses the fixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from aeroloop.service.testing.hil import Hil

PLANTS = ("emulator", "can", "can-node", "quanser", "quanser-fake")
SOFTWARE = ("emulator", "can-node", "quanser-fake")
"""Plant ends without hardware: the defaults of the conformance suite."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the `hil` fixture."""
    group = parser.getgroup("aeroloop", "hardware in the loop, with aeroloop")
    group.addoption(
        "--hil-plant",
        choices=PLANTS,
        help="plant end of `hil`: an emulator (default), a node on the configured CAN bus (can-node: an emulated node "
        "on a private bus), or Quanser's board (or its fake)",
    )
    group.addoption(
        "--hil-lockstep", action="store_true", help="run `hil` in lockstep: repeatable, as fast as the machine allows"
    )
    group.addoption("--hil-config", type=Path, help="configuration that `hil` starts from, as for --config")


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker that the conformance suite uses."""
    config.addinivalue_line("markers", "processes: starts real processes, most of them in real time")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run the conformance suite against every plant end of SOFTWARE, or against the one named."""
    if ".testing.conformance." in metafunc.module.__name__ and "hil" in metafunc.fixturenames:
        named = metafunc.config.getoption("--hil-plant")
        metafunc.parametrize("hil_plant", [named] if named else SOFTWARE, indirect=True, scope="function")


@pytest.fixture
def hil_plant(request: pytest.FixtureRequest) -> str:
    """The plant end of `hil`."""
    plant: str = getattr(request, "param", None) or request.config.getoption("--hil-plant") or "emulator"
    return plant


@pytest.fixture
def hil(request: pytest.FixtureRequest, tmp_path: Path, hil_plant: str) -> Iterator[Hil]:
    """A closed loop of real processes: start it, run it, inject faults, read its log."""
    from aeroloop.service.testing.hil import Hil

    option = request.config.getoption
    with Hil(tmp_path, lockstep=option("--hil-lockstep"), plant=hil_plant, config=option("--hil-config")) as loop:
        yield loop
