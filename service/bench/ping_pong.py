"""Ping-pong over bare Zenoh between two processes: the floor of the loop's latency.

Both ends are this file run as a program, with nothing but Zenoh in it. The pinging end sends on an absolute grid and
takes the time of the answer in the receiving thread, as a plant does; the other waits in the ring, as a loop must;
all of Zenoh runs in one thread. Slower were a Condition, a semaphore and a queue behind a callback, with and without
a thread of Python in between, and 4 to 22 threads of Zenoh in one to five pools. Faster are two things that cost a
loop its freedom: an answer from within the receiving thread, and both processes on one CPU.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Final

import zenoh
from zenoh import handlers

ONE_THREAD: Final = (
    "(app: (worker_threads: 1), rx: (handover: app), tx: (handover: app), acc: (handover: app), net: (handover: app))"
)
"""ZENOH_RUNTIME with which all of Zenoh runs in one thread."""

_PR_SET_TIMERSLACK: Final = 29
_PING, _PONG = "bench/ping", "bench/pong"
_WARM_UP_S: Final = 0.2
_LOST_S: Final = 0.5
_START_S: Final = 10.0


@dataclass(frozen=True)
class _End:
    endpoint: str
    rate_hz: float
    seconds: float
    send_bytes: int
    priority: int
    lossless: bool


def ping_pong(
    endpoint: str,
    rate_hz: float,
    seconds: float,
    *,
    payloads: tuple[int, int] = (7, 2),
    priority: int = 10,
    runtime: str | None = ONE_THREAD,
    lossless: bool = False,
) -> list[float]:
    """Round trips of a ping-pong between two processes started for it [µs]. Shape: rate_hz * seconds, less a warm-up.

    Args:
        endpoint: Zenoh endpoint between them: `tcp/127.0.0.1:PORT`, `unixsock-stream/PATH`.
        rate_hz: Pings a second; 0: back to back, as in lockstep.
        seconds: Duration [s].
        payloads: Size of a ping and of its answer [bytes].
        priority: SCHED_FIFO priority of all threads of both; 0: none.
        runtime: ZENOH_RUNTIME of both; None: Zenoh's default.
        lossless: Whether a put blocks on congestion, as in lockstep.

    Returns:
        From before a ping is put to the time at which Zenoh's receiving thread has its answer.

    Raises:
        RuntimeError: The processes do not connect, or do not get the scheduling.
    """
    variables = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
    if runtime:
        variables["ZENOH_RUNTIME"] = runtime
    ends = [_End(endpoint, rate_hz, seconds, size, priority, lossless) for size in payloads]
    pipe = subprocess.PIPE
    ping, pong = (
        subprocess.Popen(
            [sys.executable, __file__, name, json.dumps(asdict(end))],
            env=variables,
            stdin=pipe,
            stdout=pipe,
            start_new_session=True,  # ^C is this process's
        )
        for name, end in zip(("ping", "pong"), ends, strict=True)
    )
    with ping, pong:
        try:
            out, _ = ping.communicate(timeout=seconds + 2 * _START_S)
            if ping.returncode:
                raise RuntimeError(f"ping-pong over {endpoint} failed")
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"ping-pong over {endpoint} does not end") from None
        finally:
            ping.kill()
            pong.kill()
    return [float(each) for each in json.loads(out)]


def _open(end: _End, listens: bool) -> zenoh.Session:
    endpoints = {"endpoints": [end.endpoint]}
    tree = {
        "mode": "peer",
        "listen": endpoints if listens else {"endpoints": []},
        "connect": {"endpoints": []} if listens else {**endpoints, "exit_on_failure": False},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
        "open": {"return_conditions": {"connect_scouted": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(tree)))


def _publisher(session: zenoh.Session, key: str, end: _End) -> zenoh.Publisher:
    control = zenoh.CongestionControl.BLOCK if end.lossless else zenoh.CongestionControl.DROP
    return session.declare_publisher(key, priority=zenoh.Priority.REAL_TIME, congestion_control=control, express=True)


def _direct(received: Callable[[zenoh.Sample], None]) -> handlers.Callback[zenoh.Sample]:
    """Call in Zenoh's receiving thread, which keeps its state of Python, as in `protocol/transport/direct.py`."""
    kept = threading.local()

    def call(sample: zenoh.Sample) -> None:
        if not hasattr(kept, "state"):
            kept.state = ctypes.pythonapi.PyGILState_Ensure()
        received(sample)

    return handlers.Callback(call, indirect=False)


def _prepare(end: _End) -> None:
    """Scheduling as of a loop's process, on every thread."""
    gc.disable()
    if not end.priority:  # lockstep, and a host that refuses real time
        return
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with suppress(OSError):  # idle CPUs stay awake until this process ends
        os.write(os.open("/dev/cpu_dma_latency", os.O_WRONLY), bytes(4))
    for thread in os.listdir("/proc/self/task"):
        os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(end.priority))


def _pong(end: _End) -> None:
    """Answer until the standard input ends."""
    payload = bytes(end.send_bytes)
    with _open(end, listens=True) as session:
        put = _publisher(session, _PONG, end).put
        receive = session.declare_subscriber(_PING, handlers.RingChannel(1)).recv
        threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
        _prepare(end)
        while True:
            receive().payload.to_bytes()
            put(payload)


def _ping(end: _End) -> list[float]:
    """Ping on the grid; the answer's time is taken in the receiving thread, and that thread wakes this one."""
    clock, arrived, at = time.monotonic_ns, threading.Lock(), [0]
    arrived.acquire()

    def received(sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        at[0] = clock()
        if arrived.locked():
            arrived.release()

    payload, period_ns = bytes(end.send_bytes), round(1e9 / end.rate_hz) if end.rate_hz else 0
    with _open(end, listens=False) as session:
        publisher = _publisher(session, _PING, end)
        session.declare_subscriber(_PONG, _direct(received))
        _prepare(end)
        _await(lambda: bool(list(session.info.peers_zid())))
        time.sleep(_WARM_UP_S)
        trips = []
        due = begun = clock()
        while (now := clock()) < begun + round((end.seconds + _WARM_UP_S) * 1e9):
            if due > now:
                time.sleep((due - now) * 1e-9)
            due = max(due + period_ns, clock())
            sent = clock()
            publisher.put(payload)
            if arrived.acquire(timeout=_LOST_S) and sent > begun + _WARM_UP_S * 1e9:
                trips.append((at[0] - sent) * 1e-3)
    return trips


def _await(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + _START_S
    while not ready():
        if time.monotonic() > deadline:
            raise RuntimeError("the other end does not connect")
        time.sleep(0.01)


if __name__ == "__main__":
    _given = _End(**json.loads(sys.argv[2]))
    if sys.argv[1] == "ping":
        sys.stdout.write(json.dumps(_ping(_given)))
    else:
        _pong(_given)
