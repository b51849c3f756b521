"""Network cable between two processes that a test cuts and mends: a TCP relay that drops its connections."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from typing import Self


class Cable:
    """Relays TCP connections from `endpoint` to a port of loopback, as long as it is whole."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._whole = threading.Event()
        self._whole.set()
        self._ends: list[socket.socket] = []
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()
        self._hang_up()
        self._server.close()

    def cut(self) -> None:
        """No byte passes any more, and neither end is notified."""
        self._whole.clear()

    def mend(self) -> None:
        """New connections pass again; the old ones, of which bytes were lost, are gone."""
        self._hang_up()
        self._whole.set()

    def _hang_up(self) -> None:
        with self._lock:
            for end in self._ends:
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)  # wakes the thread that reads from it
            self._ends.clear()

    def _accept(self) -> None:
        with suppress(OSError):  # the server was closed
            while True:
                near, _ = self._server.accept()
                if not self._whole.is_set():
                    near.close()
                    continue
                try:
                    far = socket.create_connection(("127.0.0.1", self._port))
                except OSError:
                    near.close()
                    continue
                for end in (near, far):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                with self._lock:
                    self._ends += [near, far]
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._relay, args=(source, sink), daemon=True).start()

    def _relay(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):  # an end was closed
            while data := source.recv(65536):
                if self._whole.is_set():
                    sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.close()
