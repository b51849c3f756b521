"""The pytest plugin: a `hil` fixture for tests of one's own, on real processes.

It is there once the package is installed. What it needs is imported by the first test that asks for it.
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
"""What needs no hardware: what the contract's tests run against where nobody says otherwise."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the `hil` fixture."""
    group = parser.getgroup("aeroloop", "hardware in the loop, with aeroloop")
    group.addoption(
        "--hil-plant",
        choices=PLANTS,
        help="what stands at the plant end of `hil`: an emulator (default), a node on the CAN bus of the configuration "
        "(can-node: an emulated one on a bus of its own), or Quanser's board (or its fake)",
    )
    group.addoption(
        "--hil-lockstep", action="store_true", help="run `hil` in lockstep: repeatable, and as fast as it goes"
    )
    group.addoption("--hil-config", type=Path, help="the configuration that `hil` starts from, as for --config")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """The contract's tests run against every plant that needs no hardware, unless one is named."""
    if ".testing.conformance." in metafunc.module.__name__ and "hil" in metafunc.fixturenames:
        named = metafunc.config.getoption("--hil-plant")
        metafunc.parametrize("hil_plant", [named] if named else SOFTWARE, indirect=True, scope="function")


@pytest.fixture
def hil_plant(request: pytest.FixtureRequest) -> str:
    """What stands at the plant end of `hil`."""
    plant: str = getattr(request, "param", None) or request.config.getoption("--hil-plant") or "emulator"
    return plant


@pytest.fixture
def hil(request: pytest.FixtureRequest, tmp_path: Path, hil_plant: str) -> Iterator[Hil]:
    """A loop of real processes: start it, run it, let things go wrong, and ask its log."""
    from aeroloop.service.testing.hil import Hil

    option = request.config.getoption
    with Hil(tmp_path, lockstep=option("--hil-lockstep"), plant=hil_plant, config=option("--hil-config")) as loop:
        yield loop
