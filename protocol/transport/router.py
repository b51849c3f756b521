"""Router: a session to which clients link, and which passes on what they publish and query.

It listens at those endpoints of `network.rendezvous` that are this host's and connects to the others, which are further
routers. A stock `zenohd` does the same with the printed configuration.
"""

from __future__ import annotations

import json
from importlib.metadata import version
from typing import Any

import zenoh

from aeroloop.protocol.transport.endpoint import Endpoint
from aeroloop.protocol.transport.network import warn_of_plain
from aeroloop.protocol.transport.network_settings import NetworkError, NetworkSettings, protected
from aeroloop.protocol.transport.security import Identity
from aeroloop.protocol.transport.session_tree import THREADS, open_tree, reason, session_tree


def route(settings: NetworkSettings, identity: Identity) -> zenoh.Session:
    """Open a router's session. The caller closes it.

    Raises:
        NetworkError: It cannot listen.
        SecurityError, CertificateError: Its links cannot be secured, see `protected`.
    """
    warn_of_plain(protected(settings, identity))
    tree = router_tree(settings, identity)
    try:
        return open_tree(tree)
    except zenoh.ZError as error:
        places = ", ".join(tree["listen"]["endpoints"]) or "nothing"
        raise NetworkError(
            f"cannot listen on {places}: {reason(error)}; "
            "name a free endpoint of this host in network.rendezvous or network.listen"
        ) from None


def router_tree(settings: NetworkSettings, identity: Identity) -> dict[str, Any]:
    """Zenoh's configuration of a router, with certificate and rules as any session's. Raises as `protected`."""
    network = protected(settings, identity)
    rendezvous = network.settings.rendezvous
    here = [place for place in rendezvous if Endpoint.parse(place).is_own] or rendezvous
    others = [place for place in rendezvous if place not in here]
    tree = session_tree(network, "router", [*here, *network.settings.listen], others)
    return {
        **tree,
        "scouting": {**tree["scouting"], "delay": 0},  # otherwise it takes 0.5 s to open, whatever is linked
        # A router stamps messages by default: 26 bytes that nothing reads.
        "timestamping": {"enabled": False},
        "adminspace": {"enabled": False, "permissions": {"read": False, "write": False}},
    }


def zenohd_config(settings: NetworkSettings, identity: Identity) -> str:
    """The configuration as JSON5, for a stock `zenohd` of the same version. Raises as `protected`."""
    return (
        f"// Router of aeroloop, for zenohd {version('eclipse-zenoh')}:\n"
        f"// ZENOH_RUNTIME='{THREADS}' zenohd --config FILE\n"
        f"{json.dumps(router_tree(settings, identity), indent=2)}\n"
    )
