"""SocketCAN itself: classic and FD frames cross between sockets on `vcan0`, wherever it has to come from.

The tests that need `vcan0` are in a class that pytest collects only where it is up. The test outside runs pytest on
this folder once more, where it is.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.can.kernel import NoSocketCan, run_with_socketcan, vcan_is_up

can = pytest.importorskip("can", reason="python-can is not installed")

ROOT = Path(__file__).parent.parent.parent

TIMEOUT_S = 120.0
"""For what takes 2 s inside: a shared machine can keep a process waiting, and this one is slow to begin with."""

PATIENCE_S = 20.0

LEAN = ("-p", "no:cacheprovider", "--disable-plugin-autoload", "-o", "addopts=--import-mode=importlib")
"""Leaves nothing in this folder, and loads no plugin: importing them takes seconds inside."""


def test_frames_cross_on_a_real_socketcan() -> None:
    pytest_inside = [sys.executable, "-m", "pytest", "tests/can", "-k", "socketcan_inside", *LEAN]
    try:
        done = run_with_socketcan(pytest_inside, ROOT, TIMEOUT_S)
    except NoSocketCan as reason:
        pytest.skip(str(reason))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout, done.stdout
    assert "skipped" not in done.stdout, done.stdout


class TestInside:
    """Where `vcan0` is up."""

    __test__ = vcan_is_up()

    @pytest.mark.parametrize("fd", [False, True], ids=["classic", "FD"])
    def test_socketcan_inside_a_frame_crosses_between_two_sockets(self, fd: bool) -> None:
        data = bytes(range(64 if fd else 8))
        sent = can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=fd, bitrate_switch=fd, data=data)
        with (
            can.Bus(interface="socketcan", channel="vcan0", fd=True) as here,
            can.Bus(interface="socketcan", channel="vcan0", fd=True) as there,
        ):
            here.send(sent)
            received = there.recv(PATIENCE_S)
        assert received is not None
        assert received.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False), received
