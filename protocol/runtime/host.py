"""Host: facts and package versions that make a log interpretable a year later; names of processes and listeners."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
from contextlib import suppress
from functools import cache
from glob import iglob
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.protocol.transport.network_settings import STREAMS, Endpoint

PACKAGES: Final = ("aeroloop", "casadi", "eclipse-zenoh", "mcap", "numpy", "pydantic")
"""Packages that compute, transport or store the figures in a log."""

_ROOT: Final = Path(__file__).resolve().parents[2]
_PR_SET_NAME: Final = 15  # prctl(2)
_LISTENS: Final = "0A"  # state of a socket in /proc/net/tcp
_ROLES: Final = ("plant", "controller", "recorder", "router")


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of PACKAGES; `revision` is git's, when run from a checkout."""
    found = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    if (_ROOT / ".git").exists():
        git = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
        with suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(git, capture_output=True, text=True, timeout=2, check=True)  # noqa: S603 - arguments of our own
            found["revision"] = done.stdout.strip()
    return found


@cache
def host_facts() -> dict[str, str]:
    """The host, and its properties that affect timing; those that the system does not report are left out."""
    facts = {
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "realtime_kernel": "yes" if _read("/sys/kernel/realtime") == "1" else "no",
        "cpu": _line("/proc/cpuinfo", "model name"),
        "cpus": str(os.cpu_count() or ""),
        "memory": _line("/proc/meminfo", "MemTotal"),
        "clock": _read("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        "isolated_cpus": _read("/sys/devices/system/cpu/isolated"),
        "realtime_throttling_us": _read("/proc/sys/kernel/sched_rt_runtime_us"),
    }
    return {name: value for name, value in facts.items() if value}


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _line(path: str, name: str) -> str:
    found = (line.partition(":") for line in _read(path).splitlines())
    return next((value.strip() for key, _, value in found if key.strip() == name), "")


class Listener(NamedTuple):
    """A process that listens at a port; `role` is None where it is not a role of this program."""

    pid: int
    role: str | None

    def __str__(self) -> str:
        return f"{self.role or 'process'} with pid {self.pid}"


def name_process(role: str) -> None:
    """Name this process after its role, for `ps`, `top` and `listener`."""
    with suppress(OSError, AttributeError):  # prctl(2) takes 15 characters
        ctypes.CDLL(None).prctl(_PR_SET_NAME, f"{role}@aeroloop"[:15].encode(), 0, 0, 0)


def listener(endpoint: str) -> Listener | None:
    """The process of this user on this host that listens at a Zenoh endpoint of TCP or TLS; None if none is found."""
    place = Endpoint.parse(endpoint)
    if place.protocol not in STREAMS:
        return None
    sockets = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for cells in map(str.split, _read(table).splitlines()[1:]):
            if cells[3] == _LISTENS and int(cells[1].rpartition(":")[2], 16) == place.port:
                sockets.add(f"socket:[{cells[9]}]")
    for file in map(Path, iglob("/proc/[0-9]*/fd/*") if sockets else ()):
        with suppress(OSError):  # closed, or ended, in the meantime
            if os.readlink(file) in sockets:
                name = (file.parents[1] / "comm").read_text().strip().partition("@")[0]
                return Listener(int(file.parents[1].name), name if name in _ROLES else None)
    return None
