"""Live server with the Foxglove protocol, over Zenoh on loopback: what is shown, at which pace, to whom."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from math import degrees, radians
from queue import Queue

import pytest

from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.topics import key
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import Quaternion, distance, sent_vector
from aeroloop.service.config import Settings, load
from aeroloop.service.testing.process_group import free_rendezvous
from aeroloop.service.viewers.channels import SHAPES
from aeroloop.service.viewers.foxglove_server import FoxgloveServer, FoxgloveServerError, serve
from aeroloop.service.viewers.schemas import Decoded
from tests.support.decoded import NOW, RAW, STATUS, about, measurement, telemetry
from tests.support.viewer_double import PATIENCE_S, Shown, Viewer, orientation

TOPICS = {f"/aero/{name}" for name in SHAPES}


@pytest.fixture
def settings() -> Settings:
    return load(None, ["loop.lockstep=true", "loop.rate_hz=200", f"network.rendezvous={free_rendezvous()}"])


@contextmanager
def serving(network: NetworkSettings, rate_hz: float = 100.0) -> Iterator[str]:
    """`log live` in a thread; gives the URL."""
    stop, urls = threading.Event(), Queue[str]()
    thread = threading.Thread(
        target=serve,
        args=(network, "aero", stop),
        kwargs={"address": "127.0.0.1", "port": 0, "rate_hz": rate_hz, "ready": urls.put},
    )
    thread.start()
    try:
        yield urls.get(timeout=PATIENCE_S)
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


class Loop:
    """A moving plant and its controller over Zenoh, paced by a timer: a context.

    `attitudes` are those the body had; the tracking error at time t on the law's clock [s] is t degrees.
    """

    def __init__(self, settings: Settings) -> None:
        self._plant, self._controller = (
            Node(role, "aero", settings.network, settings.description()) for role in ("plant", "controller")
        )
        self._period, self._stop = settings.loop.period, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.attitudes: list[Quaternion] = []

    def __enter__(self) -> Loop:
        self._plant.announce()
        self._controller.announce()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._plant.zenoh.close()
        self._controller.zenoh.close()

    def trip(self) -> None:
        self._plant.publish("event", Event(role="plant", kind="tripped", text="as it was asked to"))

    def _run(self) -> None:
        measured = self._plant.zenoh.declare_publisher(key("measurement", "aero", session="s1"))
        commanded = self._controller.zenoh.declare_publisher(key("command", "aero", session="s1"))
        for k in count():
            if self._stop.wait(self._period):
                return
            self.attitudes.append(about(3, 0.01 * k % 3))
            measured.put(measurement(*sent_vector(self.attitudes[-1]), 0, 0, 0.5))
            commanded.put(RAW["command"])
            error = about(1, radians(k * self._period))
            self._controller.publish("telemetry", telemetry(error).model_copy(update={"tick": k}))
            if k % 20 == 0:
                self._plant.publish("status", STATUS)


def nearest_deg(shown: Shown, attitudes: list[Quaternion]) -> float:
    """How far a pose is from the nearest attitude that the body had."""
    pose = orientation(shown.data)
    return min(degrees(distance(pose, attitude)) for attitude in attitudes)


def test_a_loop_that_comes_after_its_viewers_is_shown_to_them_all_as_the_body_moves(settings: Settings) -> None:
    quantum_deg = degrees(4 * settings.wire.attitude.quantizer().bound)
    with serving(settings.network) as url, Viewer(url) as early:
        assert early.info["name"] == "aeroloop aero"
        early.await_topics(*TOPICS)
        assert set(early.channels) == TOPICS
        for topic, channel in early.channels.items():
            shape = SHAPES[topic.removeprefix("/aero/")]
            assert (channel["schemaName"], channel["encoding"]) == (shape.name, shape.message_encoding)
        early.subscribe(*TOPICS)
        with Loop(settings) as loop, Viewer(url) as late:
            late.await_topics(*TOPICS)
            late.subscribe("/aero/pose", "/aero/tracking")
            for viewer in (early, late):
                for _ in range(5):
                    assert nearest_deg(viewer.first("/aero/pose"), loop.attitudes) < quantum_deg
                tracking = json.loads(viewer.first("/aero/tracking").data)
                assert tracking["error_deg"] == pytest.approx(tracking["time_s"], abs=1e-3)
            loop.trip()
            assert b"tripped: as it was asked to" in early.first("/aero/log").data
            assert early.first("/aero/scene").data
            volts = json.loads(early.first("/aero/command").data)
            assert volts["voltage_2_v"] is not None


def test_what_streams_comes_at_the_pace_that_was_asked_for_and_never_twice(settings: Settings) -> None:
    """A bound by times of publication: an idle machine gives 10 a second, a busy one fewer."""
    with serving(settings.network, rate_hz=10.0) as url, Loop(settings), Viewer(url) as viewer:
        viewer.await_topics(*TOPICS)
        viewer.subscribe("/aero/pose")
        times = [viewer.first("/aero/pose").at_ns for _ in range(8)]
    assert len(set(times)) == len(times)
    assert times[-1] - times[0] > 7 * 50_000_000


def test_a_viewer_that_never_reads_delays_no_other() -> None:
    """40 MB go to it, far more than sockets and the server's backlog hold."""
    shape = SHAPES["log"]
    with (
        FoxgloveServer("aero", "127.0.0.1", 0) as outlet,
        Viewer(outlet.url, max_queue=1) as stuck,
        Viewer(outlet.url) as other,
    ):
        for viewer in (stuck, other):
            viewer.await_topics(*TOPICS)
            viewer.subscribe("/aero/log")
        await_subscribers(outlet, other)
        for _ in range(640):
            outlet.send(Decoded("/aero/log", shape, bytes(64 * 1024), NOW))
        outlet.send(Decoded("/aero/log", shape, b"the last", NOW + 1))
        while (last := other.first("/aero/log")).data != b"the last":
            assert last.at_ns <= NOW
        assert last.at_ns == NOW + 1


def await_subscribers(outlet: FoxgloveServer, viewer: Viewer) -> None:
    """Send until it arrives: then the server knows the subscription."""
    sent = threading.Event()

    def send() -> None:
        while not sent.wait(0.01):
            outlet.send(Decoded("/aero/log", SHAPES["log"], b"first", NOW))

    sender = threading.Thread(target=send)
    sender.start()
    viewer.first("/aero/log")
    sent.set()
    sender.join()


def test_a_port_in_use_is_one_clear_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(FoxgloveServerError) as refused:
            FoxgloveServer("aero", "127.0.0.1", port)
    where = f"cannot listen on 127.0.0.1:{port}: address already in use"
    assert str(refused.value) == f"{where}; choose by --address and --port"


@pytest.mark.processes
def test_the_command_prints_its_address_and_stops_on_a_signal(settings: Settings) -> None:
    """A process of its own; it may take 20 s to start and to stop, where a second is enough."""
    command = [sys.executable, "-P", "-m", "aeroloop", "log", "live", "--port", "0"]
    command += ["--set", f"network.rendezvous={settings.network.rendezvous}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert "aeroloop show layout --set vehicle=aero" in line
            url = next(word for word in line.split() if word.startswith("ws://127.0.0.1:"))
            with Viewer(url) as viewer:
                viewer.await_topics("/aero/pose")
                process.terminate()
                output, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert (process.returncode, output, errors) == (0, "", "")
