"""A node that is on the bus already, as on a bench: the conformance suite and the demo use it as it is."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.demo import node_is_on_the_bus
from aeroloop.service.testing.process_group import private_bus, start_command
from tests.support.zenoh_network import eventually

SUITE_S: Final = 300.0  # the suite takes half a minute on two idle cores; only one that hangs reaches this


def bench_file(folder: Path) -> Path:
    """Configuration of a bench on a bus of its own.

    Its watchdog is patient, because the machine may be busy; the suite takes it as it is.
    """
    bus = private_bus(CanSettings())
    path = folder / "bench.toml"
    path.write_text(
        f"""
        can = {{ options = {{ port = {bus.options["port"]}, hop_limit = 0 }} }}
        wire = {{ counter_bits = 11 }}
        controller = {{ stale_s = 2 }}
        plant = {{ watchdog_s = 2, limits = {{ max_saturated_s = 0.3 }} }}
        """
    )
    return path


@contextmanager
def node_of(config: Path) -> Iterator[Settings]:
    """The node of a bench, once it is on the bus, and the bench's settings."""
    settings = load(config)
    node = start_command(["can-node", "--config", str(config)], config.with_suffix(".txt"))
    try:
        eventually("the node is on the bus", lambda: node_is_on_the_bus(settings))
        yield settings
    finally:
        node.terminate()
        node.join()


@pytest.mark.realtime
@pytest.mark.processes
def test_the_conformance_suite_passes_against_a_node_whose_settings_it_does_not_know(tmp_path: Path) -> None:
    """In real time; slack is the suite's own, and the bench's watchdog of 2 s."""
    config = bench_file(tmp_path)
    words = ["-q", "-n0", "-p", "no:cacheprovider", "--pyargs", "aeroloop.service.testing.conformance"]
    command = [sys.executable, "-P", "-m", "pytest", *words, "--hil-plant=can", f"--hil-config={config}"]
    with node_of(config):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=SUITE_S, check=False)
    assert done.returncode == 0, done.stdout
    assert "5 passed, 1 skipped" in done.stdout  # a node's sensors fail on no request


@pytest.mark.processes
def test_a_node_on_the_bus_is_noticed_so_that_a_demo_starts_no_second_one(tmp_path: Path) -> None:
    """Without a node `SILENT_S` passes; a node's first heartbeat may take as long as a process to start."""
    config = bench_file(tmp_path)
    assert not node_is_on_the_bus(load(config))
    with node_of(config) as settings:
        assert node_is_on_the_bus(settings)
