"""What an operator's command says of places that do not answer."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import cast

from aeroloop.protocol.runtime.host import name_process
from aeroloop.protocol.transport.network import CommandSession
from aeroloop.service.host.operator import _unanswered


def test_a_process_of_this_host_is_not_taken_for_one_at_the_same_port_of_another() -> None:
    """Else a halted plant of another host goes unnamed where a controller of this one has the same port."""
    name_process("controller")
    try:
        with socket.create_server(("127.0.0.1", 0)) as here:
            places = [f"{protocol}/{host}:{here.getsockname()[1]}" for protocol, host in PLACES]
            session = cast(CommandSession, SimpleNamespace(unanswered=lambda: places, certificate=None))
            (line,) = _unanswered(session, but=("controller",))
    finally:
        name_process("pytest")
    assert line == f"the process at {places[1]} does not answer"


PLACES = ("tls", "127.0.0.1"), ("tcp", "192.0.2.1")  # this host, and one that is nobody's
