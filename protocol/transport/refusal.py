"""Why a place that accepts connections and this process do not link: found out by a TLS handshake of Python's own.

Zenoh only writes such reasons into its own log, which a program cannot read. So each process tries the handshake with
its own certificate, as a client. TLS 1.3 shows a client at once what is wrong with the server's certificate, and in an
alert, after the handshake, what the server has against its own.
"""

from __future__ import annotations

import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable
from queue import Empty, SimpleQueue
from typing import Final

from aeroloop.protocol.transport.certificate import AUTHORITY, Certificate, read_common_name

HANDSHAKE_S: Final = 0.5
"""How long a command waits for a message of a handshake [s]; usual is a millisecond."""
PLAIN_S: Final = 3.0
"""How long the watch waits [s]: a peer of Zenoh without TLS hangs up after 2 s, a halted process does not."""
FIRST_S: Final = 2.0
"""From the start of a process to its first look [s]: links are set up by then."""
EVERY_S: Final = 60.0
"""Period of the looks that follow [s]: certificates expire, and peers come up later."""

_THEIRS: Final = {
    9: "its certificate is not yet valid by this host's clock: compare the clocks, or renew it",
    10: "its certificate has expired: renew it with `aeroloop host keys renew`",
}
"""X509_V_ERR_CERT_NOT_YET_VALID and X509_V_ERR_CERT_HAS_EXPIRED, see x509_vfy.h."""
_OURS: Final = (
    ("CERTIFICATE_EXPIRED", "expired or not yet valid by its clock: compare the clocks, or renew it"),
    ("UNKNOWN_CA", "of another authority than its own"),
)
"""Names of TLS alerts: what a peer has against a certificate."""


def refusal(place: str, certificate: Certificate, wait_s: float = HANDSHAKE_S) -> str | None:
    """One line about why a peer at an endpoint of TLS and this process do not link; None if nothing speaks against it.

    A process that does not answer at all, as a halted one, is none that refuses.
    """
    if (parts := re.fullmatch(r"tls/(.+):(\d+)([?#].*)?", place)) is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # as Zenoh here: names of hosts do not matter
    try:
        context.load_verify_locations(certificate.file.with_name(AUTHORITY))
        context.load_cert_chain(certificate.file, certificate.key)
        plain = socket.create_connection((parts[1].strip("[]"), int(parts[2])), HANDSHAKE_S)
    except (OSError, ssl.SSLError):  # replaced at this moment; gone
        return None
    plain_text = f"{place} does not speak TLS: has its process a network.security.directory?"
    link, begun = None, time.monotonic()
    with plain:
        plain.settimeout(wait_s)
        try:
            with context.wrap_socket(plain) as link:
                link.recv(1)  # an alert, if any; a server of Zenoh's says nothing first
        except TimeoutError:
            return None
        except ssl.SSLCertVerificationError as error:
            foreign = f"its certificate is not of this authority, {certificate.file.with_name(AUTHORITY)}"
            return f"{place} is refused: {_THEIRS.get(error.verify_code, foreign)}"
        except (ssl.SSLEOFError, ConnectionError):  # at once: it ends
            return plain_text if link is None and time.monotonic() - begun > HANDSHAKE_S else None
        except ssl.SSLError as error:
            alert = error.reason or ""
            return _alert(place, certificate, alert) if "ALERT" in alert else plain_text
        except OSError:
            return None
    return None


def _alert(place: str, certificate: Certificate, reason: str) -> str:
    found = next((text for name, text in _OURS if name in reason), reason.lower().replace("_", " "))
    return f"{place} refuses this process's certificate {certificate.file}: {found}"


class RefusalWatch:
    """Reports, once each, the places that refuse this process or are refused by it, and links that have no right here.

    A thread looks at the places now and then, until `close`.

    Args:
        certificate: This process's own.
        vehicle: Its vehicle.
        places: Returns the endpoints at which a process may be, and to which there is no link.
        report: Called with each line, in the thread.
    """

    MAX_SAID: Final = 1000

    def __init__(
        self,
        certificate: Certificate,
        vehicle: str,
        places: Callable[[], Iterable[str]],
        report: Callable[[str], None],
    ) -> None:
        self._certificate, self._vehicle = certificate, vehicle
        self._places, self._report = places, report
        self._said: set[str] = set()
        self._lines = SimpleQueue[str]()
        self._lock, self._closed = threading.Lock(), False
        threading.Thread(target=self._run, name="refusals", daemon=True).start()

    def close(self) -> None:
        """Neither look nor report from now on; the thread ends when its handshake has."""
        with self._lock:
            self._closed = True
        self._lines.put("")  # wakes it

    def linked(self, host: str, common_name: str | None) -> None:
        """Report a link whose certificate gives its peer no right here: of no role, or of another vehicle."""
        found = read_common_name(common_name)
        if found is None:
            self._lines.put(f"{host} links with a certificate of no role, {common_name!r}: it may do nothing")
        elif found[1] not in (None, self._vehicle):
            self._lines.put(f"{host} links as {common_name}, which may do nothing to {self._vehicle}")

    def _run(self) -> None:
        due = time.monotonic() + FIRST_S
        while not self._closed:
            try:
                lines: list[str | None] = [self._lines.get(timeout=max(0.0, due - time.monotonic()))]
            except Empty:
                with self._lock:
                    places = [] if self._closed else list(self._places())
                lines = [refusal(place, self._certificate, PLAIN_S) for place in places]
                due = time.monotonic() + EVERY_S
            with self._lock:
                for line in [] if self._closed else lines:
                    if line and line not in self._said and len(self._said) < self.MAX_SAID:
                        self._said.add(line)
                        self._report(line)
