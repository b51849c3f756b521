"""Counting relay: every byte of a synthetic stream, and the overhead of frames on a Zenoh link."""

from __future__ import annotations

import socket
import threading

import pytest

from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.lab.zenoh_bytes import CountingRelay, count_bytes

SEVEN, THREE = b"1234567", b"123"
KEEPALIVES = 60
"""Bytes that a link may say beside the frames, if this machine is busy for seconds."""
PLAIN = NetworkSettings()
AROUND = 19
"""Bytes that Zenoh puts around a frame at the most: it says its key by a number, and nothing of times and senders."""


def test_a_relay_passes_every_byte_on_and_counts_each_direction() -> None:
    there, back = bytes(range(256)) * 1000, b"ab" * 5000
    with socket.create_server(("127.0.0.1", 0)) as server:
        got: list[bytes] = []

        def answer() -> None:
            taken, _ = server.accept()
            with taken, taken.makefile("rb") as stream:
                got.append(stream.read(len(there)))
                taken.sendall(back)

        thread = threading.Thread(target=answer)
        thread.start()
        with CountingRelay(server.getsockname()[1]) as relay:
            with socket.create_connection(("127.0.0.1", relay.port)) as near, near.makefile("rb") as stream:
                near.sendall(there)
                assert stream.read() == back
            thread.join()
            assert got == [there]
            assert (relay.there, relay.back) == (len(there), len(back))


def test_an_unused_relay_ends() -> None:
    with CountingRelay(1) as relay:
        pass
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", relay.port)).close()


def test_a_link_carries_more_than_the_frames_and_the_same_for_each() -> None:
    clients = NetworkSettings(mode="client")  # counted on a link of two peers all the same
    few, many = (count_bytes(mode, [SEVEN] * n, [THREE] * 2 * n) for mode, n in ((clients, 100), (PLAIN, 200)))
    assert few.measurement > 100 * len(SEVEN)
    assert few.command > 200 * len(THREE)
    for first, second in zip(few, many, strict=True):
        # A link's sequence numbers begin anywhere: a byte more or less each, on another link.
        assert abs(second - 2 * first) <= 200 * 2 + KEEPALIVES
    assert max(count_bytes(PLAIN, [], [])) <= KEEPALIVES
    longer = count_bytes(PLAIN, [SEVEN * 2] * 100, [])
    assert longer.measurement - few.measurement == pytest.approx(100 * len(SEVEN), abs=100 + KEEPALIVES)


def test_a_frame_carries_neither_time_nor_number() -> None:
    counted = count_bytes(PLAIN, [SEVEN] * 100, [THREE] * 100)
    assert counted.measurement <= 100 * (len(SEVEN) + AROUND) + KEEPALIVES
    assert counted.command <= 100 * (len(THREE) + AROUND) + KEEPALIVES
