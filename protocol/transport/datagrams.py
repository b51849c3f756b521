"""Datagrams: a second Zenoh session of a loop's two ends, which carries their frames over UDP.

Over TCP, and so over TLS, one lost packet holds back all that follow until it has been sent again: 0.2 s and more, in
which the plant's watchdog trips. A lost frame needs nothing: the next one replaces it. So between hosts claims, verbs,
tokens and traces stay where they are, and frames get a session of their own: a QUIC connection, whose datagrams carry
the frames and whose stream carries what Zenoh declares. With certificates it is encrypted, and both ends have one.

The plant listens at the first free port of its host's places, by UDP, and names the endpoint in its status. The
controller connects to it before it claims; without such a link its frames stay on the first session.

Why not a second link of the first session: the first link of a peer carries Zenoh's declarations. If that is UDP, which
has the shortest handshake, a lost packet costs a subscription for good. Why not all on one connection: QUIC's
retransmissions of traces then hold up its datagrams.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from typing import Final

import zenoh

from aeroloop.protocol.transport.endpoint import Endpoint
from aeroloop.protocol.transport.network import open_session
from aeroloop.protocol.transport.network_settings import NetworkSettings, protected
from aeroloop.protocol.transport.security import Identity

LINK_S: Final = 5.0
"""How long claims are put off for the link to a plant [s]: at 20 % loss a handshake takes up to 4 s, usually 0.02 s."""
_SOON_S: Final = 0.2
_POLL_S: Final = 0.005
_CARRIERS: Final = {"tcp": "udp", "tls": "quic"}
"""By the protocol of an endpoint, that of its datagrams: as plain, or as protected."""
_MIXED: Final = "?rel=1;mixed_rel=1"
"""Zenoh's words for a QUIC connection with a reliable stream and with datagrams."""


class Datagrams:
    """The session of one end's frames; none until `listen` or `connect`, on loopback, or where settings want none."""

    def __init__(self, settings: NetworkSettings, identity: Identity) -> None:
        self._settings = settings
        self._identity = identity
        self._put_off_until = 0.0
        self.session: zenoh.Session | None = None
        self.endpoint = ""

    @property
    def wanted(self) -> bool:
        """Whether frames are to travel by datagrams, so that a plant's endpoint is worth asking for."""
        return self._settings.mixed

    @property
    def linked(self) -> bool:
        """Whether there is a link to a peer now."""
        return self.session is not None and bool(self.session.info.peers_zid())

    def listen(self) -> None:
        """Listen at the first free one of this host's places, if datagrams are wanted; `endpoint` then names it."""
        if not self.wanted:
            return
        network = protected(self._settings, self._identity)
        for endpoint in filter(None, map(_datagrams_of, network.settings.places)):
            if not Endpoint.parse(endpoint).is_free:
                continue
            with suppress(zenoh.ZError):  # taken in the meantime
                self.session = open_session(network, listen=[endpoint])
                self.endpoint = endpoint
                return

    def connect(self, endpoint: str) -> bool | None:
        """Connect to a plant's endpoint; whether there is a link. None while that is not decided, for up to `LINK_S`.

        An endpoint that is not among the network's own places is refused: a status from elsewhere leads nowhere.
        """
        network = protected(self._settings, self._identity)
        if endpoint not in map(_datagrams_of, network.settings.places):
            return False
        if endpoint != self.endpoint or self.session is None:
            self.close()
            self.session, self.endpoint = open_session(network, connect=[endpoint]), endpoint
            self._put_off_until = time.monotonic() + LINK_S
        soon = time.monotonic() + _SOON_S
        while not self.linked and time.monotonic() < min(soon, self._put_off_until):
            time.sleep(_POLL_S)
        return self.linked or (None if time.monotonic() < self._put_off_until else False)

    def close(self) -> None:
        """Close the session, if there is one."""
        if self.session is not None:
            self.session.close()
            self.session = None


def _datagrams_of(place: str) -> str | None:
    """The endpoint of datagrams beside a place: the same address and port, by UDP. None on loopback."""
    endpoint = Endpoint.parse(place)
    if not endpoint.leaves_host:
        return None
    return str(replace(endpoint, protocol=_CARRIERS[endpoint.protocol], words=_MIXED))
