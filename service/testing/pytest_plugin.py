"""Pytest plugin: provides the `hil` fixture, a closed loop of real processes, and evidence of a failed test.

It imports the loop's modules only when a test uses the fixture.
"""

from __future__ import annotations

import shutil
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from aeroloop.protocol.printable import printable

if TYPE_CHECKING:
    from aeroloop.service.testing.hil import Hil

SOFTWARE = ("emulator", "can-node", *(("can-node-c",) if shutil.which("cc") else ()))
"""Plant ends without hardware: the defaults of the conformance suite. The node in C needs a compiler."""
_LOOP: Final = pytest.StashKey["Hil"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the `hil` fixture."""
    group = parser.getgroup("aeroloop", "hardware in the loop, with aeroloop")
    group.addoption(
        "--hil-plant",
        metavar="PLANT",
        help="plant end of `hil`: emulator (default); can, a node on the configured CAN bus; can-node, an emulated "
        "node on a private bus; can-node-c, the same in C; quanser, the board; or package.module:Class, your own plant",
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
        request.node.stash[_LOOP] = loop
        yield loop


@pytest.hookimpl(wrapper=True, tryfirst=True)  # outermost: sees the outcome after `xfail` has changed it
def pytest_runtest_makereport(
    item: pytest.Item,
    call: pytest.CallInfo[None],  # noqa: ARG001  # the hook's argument
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the evidence of a failed test's loop to its report, while the loop's folder is still there."""
    report = yield
    if report.when == "call" and report.failed and (loop := item.stash.get(_LOOP, None)) and (lines := loop.evidence()):
        report.sections.append(("hil", "\n".join(map(printable, lines))))
    return report
