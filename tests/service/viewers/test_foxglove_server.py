"""Live server with the Foxglove protocol, over Zenoh on loopback: what is shown, and to whom."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.topics import key
from aeroloop.protocol.runtime.node import Node
from aeroloop.service.config import Settings, load
from aeroloop.service.testing.process_group import free_rendezvous
from aeroloop.service.viewers.channels import SHAPES
from aeroloop.service.viewers.foxglove_server import FoxgloveServerError, listening
from tests.support.decoded import ATTITUDE, RAW, STATUS, telemetry
from tests.support.viewer_double import PATIENCE_S, Viewer

TOPICS = {f"/aero/{name}" for name in SHAPES}


@contextmanager
def serving(settings: Settings) -> Iterator[str]:
    """`log live` as a process, which stops on a signal; gives the URL that it prints."""
    command = [sys.executable, "-P", "-m", "aeroloop", "log", "live", "--port", "0"]
    command += ["--set", f"network.rendezvous={settings.network.rendezvous}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert "aeroloop show layout --set vehicle=aero" in line
            yield next(word for word in line.split() if word.startswith("ws://127.0.0.1:"))
            process.terminate()
            output, errors = process.communicate(timeout=PATIENCE_S)
            assert (process.returncode, output, errors) == (0, "", "")
        finally:
            process.kill()


@contextmanager
def loop(settings: Settings) -> Iterator[Node]:
    """A plant and its controller over Zenoh that publish; the plant."""
    plant, controller = (
        Node(role, "aero", settings.network, settings.description()) for role in ("plant", "controller")
    )
    measured = plant.zenoh.declare_publisher(key("measurement", "aero", session="s1"))
    commanded = controller.zenoh.declare_publisher(key("command", "aero", session="s1"))

    def publish() -> None:
        measured.put(RAW["measurement"])
        commanded.put(RAW["command"])
        controller.publish("telemetry", telemetry(ATTITUDE))
        plant.publish("status", STATUS)

    plant.announce()
    controller.announce()
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.01):
            publish()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield plant
    finally:
        stop.set()
        thread.join()
        plant.zenoh.close()
        controller.zenoh.close()


@pytest.mark.processes
def test_a_loop_that_comes_after_its_viewers_is_shown_to_them_all() -> None:
    """The server may take 20 s to start and to stop, where a second is enough."""
    settings = load(None, ["loop.lockstep=true", f"network.rendezvous={free_rendezvous()}"])
    with serving(settings) as url, Viewer(url) as early:
        assert early.info["name"] == "aeroloop aero"
        early.await_topics(*TOPICS)
        assert set(early.channels) == TOPICS
        for topic, channel in early.channels.items():
            shape = SHAPES[topic.removeprefix("/aero/")]
            assert (channel["schemaName"], channel["encoding"]) == (shape.name, shape.message_encoding)
        early.subscribe(*TOPICS)
        with loop(settings) as plant, Viewer(url) as late:
            late.await_topics(*TOPICS)
            late.subscribe("/aero/tf", "/aero/tracking")
            for viewer in (early, late):
                first, second = (viewer.first("/aero/tf").at_ns for _ in range(2))
                assert second > first
                assert viewer.first("/aero/tracking").data
            plant.publish("event", Event(role="plant", kind="tripped", text="as it was asked to"))
            assert b"tripped: as it was asked to" in early.first("/aero/log").data
            assert all(early.first(f"/aero/{name}").data for name in ("scene", "command", "status/plant"))


def test_a_port_in_use_is_one_clear_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(FoxgloveServerError) as refused, listening("aero", "127.0.0.1", port):
            pass
    where = f"cannot listen on 127.0.0.1:{port}: address already in use"
    assert str(refused.value) == f"{where}; choose by --address and --port"
