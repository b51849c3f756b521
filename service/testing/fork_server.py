"""Fork server: starts commands from a process that has already imported everything.

A process of a loop imports for over half a second of a core. The server does it once; each command is a fork of it
that runs the command line with its own arguments. The server opens no session and runs no Python thread, so a fork
inherits modules only.

    this process  → server   request: arguments, environment, folder; with it stderr and the writing end of a pipe
    server        → this     the child's process id
    server        → pipe     the child's exit code at its end; closed without one if the server has died

The server ends its children and itself when its socket closes: at the end of this process, however it ends.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from threading import Lock
from typing import Final

_CODE: Final = struct.Struct("<i")
_REQUEST_BYTES: Final = 1 << 20
_COMMAND: Final = "aeroloop.service.cli.entry"
_PRELOADED: Final = (
    _COMMAND,
    "aeroloop.service.cli.main",
    "aeroloop.service.cli.run",
    "aeroloop.service.terminal.encoding",
    "aeroloop.service.daemon.daemon",
    "aeroloop.service.daemon.roles",
    "aeroloop.service.recording.recorder",
    "aeroloop.service.viewers.channels",
    "aeroloop.plant_emulator.hosts.can_node",
    "casadi",  # the modules above import it at its first use
)


class ForkedProcess:
    """A child of the fork server, used like `subprocess.Popen`; `returncode` is None if it ran at the last poll."""

    def __init__(self, pid: int, result: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._result = result  # descriptor of the reading end of the pipe

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        return self._read(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it ends; return its exit code.

        Raises:
            subprocess.TimeoutExpired: It still runs after `timeout` [s].
        """
        code = self._read(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):  # ended, and its exit code is on the way
                os.kill(self.pid, sig)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def _read(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and select.select([self._result], [], [], timeout_s)[0]:
            code = os.read(self._result, _CODE.size)
            os.close(self._result)
            self.returncode = _CODE.unpack(code)[0] if code else -signal.SIGKILL
        return self.returncode


class ForkServer:
    """A process that has imported what roles import."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "aeroloop.service.testing.fork_server", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Process id, the parent of its children."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the server and its children."""
        self._socket.close()
        self._process.wait()

    def start(self, arguments: Sequence[str], environment: Mapping[str, str], stderr: int) -> ForkedProcess:
        """Run `aeroloop` with these arguments and no other environment, in this folder and a new process session.

        Raises:
            OSError: The server has died.
        """
        result, theirs = os.pipe()
        request = json.dumps({"arguments": [*arguments], "environment": {**environment}, "folder": os.getcwd()})
        try:
            with self._lock:
                socket.send_fds(self._socket, [request.encode()], [stderr, theirs])
                pid = self._socket.recv(_CODE.size)
        finally:
            os.close(theirs)
        if not pid:
            os.close(result)
            raise OSError("the fork server has died")
        return ForkedProcess(_CODE.unpack(pid)[0], result)


_servers: dict[int, ForkServer] = {}


def fork_server() -> ForkServer:
    """The server of this process, started at the first call and again if it has died."""
    mine = os.getpid()  # a fork of this process starts its own
    if mine not in _servers or not _servers[mine].alive:
        _servers[mine] = ForkServer()
        atexit.register(_servers[mine].close)
    return _servers[mine]


# ── the server's side ──


def _serve(control: socket.socket) -> list[str] | None:
    """Fork for each request. In a child, return its arguments; in the server None, once the socket is closed."""
    woken, waker = os.pipe()
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    results: dict[int, int] = {}
    while True:
        ready = select.select([control.fileno(), woken], [], [])[0]
        if woken in ready:
            os.read(woken, 4096)
            _report(results)
        if control.fileno() not in ready:
            continue
        request, descriptors, _, _ = socket.recv_fds(control, _REQUEST_BYTES, 2)
        if not request:
            for pid in results:
                os.kill(pid, signal.SIGTERM)
            return None
        stderr, result = descriptors
        pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            control.close()
            os.dup2(stderr, sys.stderr.fileno())
            for descriptor in (woken, waker, stderr, result, *results.values()):
                os.close(descriptor)
            parsed = json.loads(request)
            os.setsid()
            os.environ.clear()
            os.environ.update(parsed["environment"])
            os.chdir(parsed["folder"])
            return list(parsed["arguments"])
        os.close(stderr)
        results[pid] = result
        control.send(_CODE.pack(pid))


def _report(results: dict[int, int]) -> None:
    """Write the exit codes of children that have ended."""
    while results:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if not pid:
            return
        result = results.pop(pid)
        with suppress(BrokenPipeError):
            os.write(result, _CODE.pack(os.waitstatus_to_exitcode(status)))
        os.close(result)


def main() -> None:
    """Serve on the socket with the descriptor of the first argument."""
    for module in _PRELOADED:
        with suppress(ModuleNotFoundError):  # of an extra that is not installed
            importlib.import_module(module)
    gc.freeze()  # a collection in a child would touch, and so copy, shared pages
    arguments = _serve(socket.socket(fileno=int(sys.argv[1])))
    if arguments is not None:
        sys.argv[1:] = arguments
        sys.modules[_COMMAND].main()


if __name__ == "__main__":
    main()
