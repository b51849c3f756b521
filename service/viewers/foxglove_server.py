"""Live WebSocket server of decoded topics for Foxglove and Lichtblick.

A process of its own that only subscribes. Frames and other streaming topics wait in rings of one, written by Zenoh's
own threads, and are taken at a fixed rate: what is published in between is never decoded. foxglove-sdk sends from
threads of its own and drops what a slow client does not take, so a slow client delays neither other clients nor the
loop.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from threading import Event
from typing import Final

import foxglove
from zenoh.handlers import RingChannel

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.history import RecoveringSubscriber, read_sample
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.viewers.channels import SHAPES, Decoder
from aeroloop.service.viewers.schemas import Decoded

ROOM: Final = 1024  # events, losses or statuses that may wait to be taken; of streaming topics, one message
BACKLOG: Final = 256  # messages that wait for one slow client, about a second of all; beyond, its oldest are dropped


class FoxgloveServerError(AeroloopError):
    """The server cannot be started; one line with the reason and a remedy."""


@contextmanager
def listening(vehicle: str, address: str, port: int) -> Iterator[tuple[str, Callable[[Decoded], None]]]:
    """A WebSocket server with a channel per topic: its URL, and a function that sends a message and never blocks.

    Port 0 is any free one. Raises FoxgloveServerError if it cannot listen there.
    """
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # no log line for each client
    context = foxglove.Context()  # channels and server live as long
    channels = {
        topic: foxglove.Channel(
            topic,
            schema=foxglove.Schema(name=shape.name, encoding=shape.encoding, data=shape.schema),
            message_encoding=shape.message_encoding,
            context=context,
        )
        for topic, shape in ((f"/{vehicle}/{name}", shape) for name, shape in SHAPES.items())
    }
    host = f"[{address}]" if ":" in address else address
    try:
        server = foxglove.start_server(
            name=f"aeroloop {vehicle}", host=address, port=port, context=context, message_backlog_size=BACKLOG
        )
    except RuntimeError as error:
        reason = str(error).rpartition("Failed to bind port: ")[2].partition(" (os error")[0]
        text = f"cannot listen on {host}:{port}: {reason.lower()}; choose by --address and --port"
        raise FoxgloveServerError(text) from None

    def send(message: Decoded) -> None:
        channels[message.topic].log(message.data, log_time=message.at_ns)

    try:
        yield f"ws://{host}:{server.port}", send
    finally:
        server.stop()


def serve(
    network: NetworkSettings, vehicle: str, stop: Event, *,
    address: str, port: int, rate_hz: float, ready: Callable[[str], None],
) -> None:  # fmt: skip
    """Show a vehicle until `stop` is set.

    Messages are taken, decoded and sent at `rate_hz` [Hz]. `ready` is called with the URL once clients can connect;
    port 0 is any free one.

    Raises:
        FoxgloveServerError: The address or port cannot be listened on.
        NetworkError: The network cannot be joined.
    """
    decoder = Decoder(None)  # what is taken is bounded
    shown = [topic for topic in topics.TOPICS.values() if topic.decoded or topic.kind == "frame"]
    rooms = {topics.key(topic.name, vehicle): ROOM if topic.decoded == "always" else 1 for topic in shown}
    with listening(vehicle, address, port) as (url, send), join(network, listen=False) as session:
        descriptions = RecoveringSubscriber(session, topics.key("description", vehicle))
        rings = [(session.declare_subscriber(key, RingChannel(room)), room) for key, room in rooms.items()]
        ready(url)
        while not stop.wait(1 / rate_hz):
            taken = [sample for ring, room in rings for sample in islice(iter(ring.try_recv, None), room)]
            for received in (*descriptions.take(), *map(read_sample, taken)):
                if topic := topics.read_key(received.key):
                    for message in decoder.take(topic, received.payload, received.published_ns):
                        send(message)
