"""Probes of endpoints with sockets of Python's own: which accept connections, and why TLS links do not come about.

Zenoh writes such reasons only into its own log, which a program cannot read. TLS 1.3 shows a client at once what is
wrong with the server's certificate, and in an alert, after the handshake, what the server has against its own.
"""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Final

from aeroloop.protocol.transport.certificate import AUTHORITY, Certificate
from aeroloop.protocol.transport.endpoint import Endpoint

ACCEPT_S: Final = 0.25  # how long `accepting` waits for a connection
HANDSHAKE_S: Final = 0.5  # how long a command waits for a message of a handshake; usual is a millisecond
PLAIN_S: Final = 3.0  # for a peer of Zenoh without TLS, which hangs up after 2 s; a halted process does not
_AGAIN: Final = "compare the clocks, or issue it anew with `aeroloop host keys issue`"
_THEIRS: Final = {9: f"is not yet valid by this host's clock: {_AGAIN}", 10: f"has expired: {_AGAIN}"}  # x509_vfy.h
_OURS: Final = {"EXPIRED": f"expired or not yet valid by its clock: {_AGAIN}", "UNKNOWN_CA": "not of its authority"}


def accepting(endpoints: Sequence[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""

    def accepts(endpoint: Endpoint) -> bool:
        if endpoint.protocol in ("tcp", "tls") and endpoint.port is not None:
            with suppress(OSError), socket.create_connection(endpoint.address, ACCEPT_S):
                return True
        return False

    with ThreadPoolExecutor(max(1, len(endpoints))) as pool:
        found = pool.map(accepts, map(Endpoint.parse, endpoints))
        return [text for text, accepted in zip(endpoints, found, strict=True) if accepted]


def refusal(text: str, certificate: Certificate, wait_s: float = HANDSHAKE_S) -> str | None:
    """One line about why a peer at an endpoint of TLS and a process with this certificate do not link.

    None if nothing speaks against it, and where no process answers.
    """
    endpoint = Endpoint.parse(text)
    if endpoint.protocol != "tls":
        return None
    authority = certificate.file.with_name(AUTHORITY)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # as Zenoh here: names of hosts do not matter
    plain_text = f"{text} does not speak TLS: has its process a network.security.directory?"
    link, begun = None, time.monotonic()
    try:
        context.load_verify_locations(authority)
        context.load_cert_chain(certificate.file, certificate.key)
        with socket.create_connection(endpoint.address, HANDSHAKE_S) as plain:
            plain.settimeout(wait_s)
            begun = time.monotonic()
            with context.wrap_socket(plain) as link:
                link.recv(1)  # an alert, if any; a server of Zenoh's says nothing first
    except ssl.SSLCertVerificationError as error:
        why = _THEIRS.get(error.verify_code, f"is not of this authority, {authority}")
        return f"{text} is refused: its certificate {why}"
    except (ssl.SSLEOFError, ConnectionError):  # at once: it ends, or nothing listens
        return plain_text if link is None and time.monotonic() - begun > HANDSHAKE_S else None
    except ssl.SSLError as error:
        alert = error.reason or ""
        why = next((words for name, words in _OURS.items() if name in alert), alert.lower().replace("_", " "))
        return f"{text} refuses the certificate {certificate.file}: {why}" if "ALERT" in alert else plain_text
    except OSError:  # no answer in time; files that were just replaced
        return None
    return None
