"""Callbacks in Zenoh's threads: a thread keeps Python's state between its messages."""

from __future__ import annotations

import resource
import threading

import zenoh

from aeroloop.protocol.transport.direct import direct
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

MESSAGES = 400


def test_a_received_message_costs_its_thread_no_page_fault() -> None:
    faults: dict[int, list[int]] = {}  # of each receiving thread, at each of its messages
    received = threading.Semaphore(0)

    def receive(_: zenoh.Sample) -> None:
        counted = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        faults.setdefault(threading.get_ident(), []).append(counted)
        received.release()

    with Gathering() as gathering:
        here, there = gathering.join(), gathering.join()
        here.declare_subscriber("frames", direct(receive))
        publisher = there.declare_publisher("frames")
        eventually("a subscriber", lambda: publisher.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool
        for _ in range(MESSAGES):  # each for itself: several that arrive at once share a state
            publisher.put(b"frame")
            assert received.acquire(timeout=PATIENCE_S)
    assert threading.get_ident() not in faults
    assert sum(len(each) for each in faults.values()) == MESSAGES
    assert sum(each[-1] - each[0] for each in faults.values()) < MESSAGES / 4  # one at each message, unless kept
