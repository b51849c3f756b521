"""Host facts and package versions for a role's description, which make a log interpretable a year later."""

from __future__ import annotations

import os
import platform
import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Final

PACKAGES: Final = ("aeroloop", "casadi", "eclipse-zenoh", "mcap", "numpy", "pydantic")
"""Packages that compute, transport or store the figures in a log."""

_ROOT: Final = Path(__file__).resolve().parents[2]
_GIT_WAIT_S: Final = 2.0


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of PACKAGES; `revision` is git's, when run from a checkout."""
    found = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    revision = _revision()
    return {**found, "revision": revision} if revision else found


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


def _revision() -> str:
    """`git describe` of this checkout, with `-dirty` if files were changed; empty outside of a checkout."""
    if not (_ROOT / ".git").exists():
        return ""
    try:
        done = subprocess.run(  # noqa: S603 - arguments of our own
            ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=12"],  # noqa: S607 - any git will do
            capture_output=True,
            text=True,
            timeout=_GIT_WAIT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _line(path: str, name: str) -> str:
    found = (line.partition(":") for line in _read(path).splitlines())
    return next((value.strip() for key, _, value in found if key.strip() == name), "")
