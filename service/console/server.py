"""Server of the console: one page over HTTP, and a socket for what it shows and what an operator asks for.

Only a further client of the network, in a process of its own. A page needs the token of the printed address; requests
of another host or origin are refused. Each page has a thread, which sends the newest block once the last is gone, so a
slow page has no queue. Without an operator's certificate where the network has certificates, nothing is sent there.
"""

from __future__ import annotations

import logging
import secrets
import ssl
import time
from contextlib import suppress
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

import zenoh
from pydantic_core import to_json
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.printable import printable
from aeroloop.protocol.transport.history import RecoveringSubscriber
from aeroloop.protocol.transport.network import joined_session
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.console.feed import SHOWN, Feed, Vehicle
from aeroloop.service.console.verbs import PageRequest, VerbError, Verbs
from aeroloop.service.host.health import troubles
from aeroloop.service.report.page import rendered

BLOCK_S: Final = 0.1  # at most so many blocks a second go to a page
_POLICY: Final = {"Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}


class ConsoleError(AeroloopError):
    """The console cannot be served; one line with the reason and what to do."""


class Console:
    """A console of a network: pages are served until it is closed. `url` has the token."""

    def __init__(
        self, network: NetworkSettings, address: str, port: int, tls: tuple[Path, Path] | None, vehicle: str | None
    ) -> None:
        local, context = _is_loopback(address), None
        if tls is None and not local:
            raise ConsoleError(
                f"{address} is beyond this host, where the console speaks TLS only: give --tls CERTIFICATE KEY, or "
                "forward a port by ssh"
            )
        if tls is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            try:
                context.load_cert_chain(*tls)
            except (OSError, ssl.SSLError) as error:
                raise ConsoleError(f"--tls {tls[0]} {tls[1]}: {error.strerror or error}") from None
        self._feed, self._vehicle, self._token = Feed(), vehicle, secrets.token_urlsafe(24)
        self._session = joined_session(network)
        here = self._session.__enter__()
        certificate = here.certificate
        self.reads_only = certificate is not None and certificate.role != "operator"
        self._verbs = Verbs(network, here, self._feed)
        keys = [topics.key(name, "*") for name in SHOWN if name != "description"]
        self._subscribers = [here.session.declare_subscriber(key, self._receive) for key in keys]
        self._descriptions = RecoveringSubscriber(here.session, topics.key("description", "*"))
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # no line for each page
        try:
            self._server = serve(
                self._page, address, port, ssl=context, process_request=self._request, compression=None, max_size=65_536
            )
        except OSError as error:
            self._session.__exit__(None, None, None)
            raise ConsoleError(f"cannot listen on {address}:{port}: {error.strerror}; choose another --port") from None
        port = self._server.socket.getsockname()[1]
        host = f"[{address}]" if ":" in address else address
        names = {"localhost", "127.0.0.1", "[::1]"} if local else {host}
        self._hosts = {f"{name}:{port}" for name in names}
        self.origin = f"{'https' if tls else 'http'}://{host}:{port}"
        self._origins = {f"{'https' if tls else 'http'}://{each}" for each in self._hosts}
        self.url = f"{self.origin}/?token={self._token}"

    def run(self, stop: Event) -> None:
        """Serve until `stop` is set, or an exception ends it: a Python process with an open session would not end."""
        Thread(target=self._server.serve_forever, daemon=True).start()
        try:
            while not stop.wait(BLOCK_S):
                for one in self._descriptions.take():
                    self._feed.take(one.key, one.payload, time.monotonic(), one.published_ns * 1e-9)
        finally:
            try:
                self._server.shutdown()
            finally:
                self._session.__exit__(None, None, None)

    def _receive(self, sample: zenoh.Sample) -> None:
        self._feed.take(str(sample.key_expr), sample.payload.to_bytes(), time.monotonic(), time.time())

    # ── HTTP ──

    def _request(self, _: ServerConnection, request: Request) -> Response | None:
        """Answer a request, or let the socket of one of our own pages through."""
        path = urlsplit(request.path)
        given = parse_qs(path.query).get("token", [""])[0]
        origin = request.headers.get("Origin")
        if request.headers.get("Host", "") not in self._hosts or origin not in (None, *self._origins):
            return _answer(HTTPStatus.FORBIDDEN, "a request of another host or origin\n")
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            return _answer(HTTPStatus.UNAUTHORIZED, "the address lacks its token: `aeroloop op console` prints it\n")
        if path.path == "/socket":
            return None if origin is not None else _answer(HTTPStatus.FORBIDDEN, "a socket without an origin\n")
        if path.path != "/":
            return _answer(HTTPStatus.NOT_FOUND, "nothing is here\n")
        vehicle = self._named(parse_qs(path.query).get("vehicle", [""])[0])
        with self._feed.lock:
            known = {"generation": vehicle.generation, "columns": vehicle.columns, "verdict": vehicle.verdict}
            report = vehicle.report()
        names = {**known, "vehicle": vehicle.name, "reads_only": self.reads_only}
        html = rendered("console.html", [report], "console.js", live=True, **names)
        return _answer(HTTPStatus.OK, html, "text/html; charset=utf-8")

    def _named(self, name: str) -> Vehicle:
        """The vehicle asked for, else the configured one, else the first with a plant or a controller."""
        with self._feed.lock:
            known = self._feed.vehicles
            ends = (each for each, its in sorted(known.items()) if {"plant", "controller"} & its.statuses.keys())
            wanted = name or self._vehicle or next(ends, "aero")
            return known.get(wanted) or Vehicle(wanted)

    # ── a page's socket ──

    def _page(self, socket: ServerConnection) -> None:
        """Answer what a page asks for, while a thread of its own sends what it shows; nothing delays a stop."""
        assert socket.request is not None
        name, shown = self._named(parse_qs(urlsplit(socket.request.path).query).get("vehicle", [""])[0]).name, Event()
        Thread(target=self._stream, args=(socket, name, shown), daemon=True).start()
        with suppress(ConnectionClosed, OSError):
            for text in socket:
                try:
                    asked = PageRequest.read(text)
                except VerbError as error:
                    _send(socket, {"type": "answer", "number": None, "verb": "", "failed": str(error)})
                    continue
                if asked.verb == "shown":
                    shown.set()
                elif asked.verb == "stop":
                    Thread(target=self._answer, args=(socket, asked), daemon=True).start()
                else:
                    self._answer(socket, asked)
        shown.set()

    def _stream(self, socket: ServerConnection, name: str, shown: Event) -> None:
        """Send the newest block, over and over, each once the page has `shown` the last: a slow one has no queue."""
        rows, events, session = 0, 0, ""
        with suppress(ConnectionClosed, OSError):
            while True:
                with self._feed.lock:
                    found = self._feed.gathered(time.monotonic())
                    block = self._feed.block(name, rows, events, session)
                rows, events, session = block.get("count", 0), block["numbered"], block.get("session", "")
                statuses = {
                    vehicle: {role: _shown(status) for role, status in roles.items()}
                    for vehicle, roles in found.statuses.items()
                }
                wrong = [{"vehicle": one.vehicle, "role": one.role, "text": one.text} for one in troubles(found)]
                shown.clear()
                _send(socket, {"type": "block", "vehicles": statuses, "troubles": wrong, **block})
                time.sleep(BLOCK_S)
                shown.wait()

    def _answer(self, socket: ServerConnection, asked: PageRequest) -> None:
        """Do what a page asks for, and send what came of it."""
        answer: dict[str, Any] = {"type": "answer", "number": asked.number, "verb": asked.verb}
        try:
            if self.reads_only and asked.verb != "preview":
                raise ConsoleError("this console only reads: it has no operator's certificate")
            answer |= self._verbs.do(asked)
        except (AeroloopError, ValueError, ArithmeticError, zenoh.ZError) as error:
            answer |= {"failed": printable(str(error))}
        with suppress(ConnectionClosed, OSError):
            _send(socket, answer)


def _send(socket: ServerConnection, message: dict[str, Any]) -> None:
    """Send a message as JSON, which has no NaN and no ∞: they are null."""
    socket.send(to_json(message, inf_nan_mode="null"), text=True)


def _is_loopback(address: str) -> bool:
    """Whether an address to listen on is this host's alone. Raises ConsoleError for every address at once."""
    try:
        found = ip_address(address)
    except ValueError:  # a host's name
        return address == "localhost"
    if found.is_unspecified:
        raise ConsoleError(f"{address} is every address: give --address the one that browsers use, as it is checked")
    return found.is_loopback


def _shown(status: Status) -> dict[str, Any]:
    """What a page shows of a status."""
    names = "state session cause age_s rate_hz skipped recent_skipped lost lacks_recorder reference notes unkept"
    found = {name: getattr(status, name) for name in names.split()}
    if status.recent_latency_us is not None:
        found["latency_us"] = [status.recent_latency_us.p50, status.recent_latency_us.p99]
    if status.gains is not None:
        found["gains"] = {name: list(gain) for name, gain in status.gains.named.items()}
    found["faults"] = [fault.fault for fault in status.faults if fault.end_tick is None]
    return found


def _answer(status: HTTPStatus, body: str, kind: str = "text/plain; charset=utf-8") -> Response:
    payload = body.encode()
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(payload)), "Connection": "close", **_POLICY})
    return Response(status.value, status.phrase, headers, payload)
