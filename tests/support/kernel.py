"""SocketCAN kernel for a test's command, also on a machine whose kernel has none.

`run_with_socketcan` runs a command where `vcan0` is up and carries CAN FD: here, if it is; else in user-mode Linux, a
kernel that is an ordinary program, from the distribution's package, unpacked into a cache the first time, not
installed. It needs neither root nor hardware. It boots on this machine's files, so the same interpreter runs inside,
and this file is its init: the part under "Inside" runs there as process 1, with the standard library and `ip` alone.
Inside, files are read-only except for the command's working directory and TMPDIR, and a process is several times
slower, so only tests without real time run there.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import platform
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

INTERFACE, FD_MTU = "vcan0", 72
"""An interface with this MTU, sizeof(struct canfd_frame), carries both classic CAN and CAN FD."""
PACKAGE, MODULES = "user-mode-linux", ("can-dev", "vcan", "can", "can-raw")
"""Modules in the order in which they need each other."""
FETCH_S, BOOT_S = 300.0, 60.0
"""Slack for 40 MB of package after 10 MB of lists; for booting and halting, which take 2 s of CPU."""


class NoSocketCan(Exception):  # noqa: N818 - it is a state of this machine, not an error
    """There is no SocketCAN on this machine and no way to get it; says why in one line."""


def run_with_socketcan(command: Sequence[str], cwd: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Run a command where `vcan0` is up, in `cwd`, where it may write.

    Raises NoSocketCan, subprocess.TimeoutExpired, or RuntimeError if its kernel ended before it did.
    """
    return _run(command, cwd, timeout_s) if vcan_is_up() else _run_in_uml(command, cwd, timeout_s)


def vcan_is_up() -> bool:
    """Whether `vcan0` is here, up and carries CAN FD, as it does for a command under `run_with_socketcan`."""
    siocgifflags, siocgifmtu, iff_up = 0x8913, 0x8921, 1
    request = struct.pack("16s24x", INTERFACE.encode())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            (flags,) = struct.unpack("16xH22x", fcntl.ioctl(any_socket, siocgifflags, request))
            (mtu,) = struct.unpack("16xi20x", fcntl.ioctl(any_socket, siocgifmtu, request))
        except OSError:
            return False
    return bool(flags & iff_up) and mtu == FD_MTU


def _run(
    command: Sequence[str], cwd: Path, timeout_s: float, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command without input, and leave none of its children behind."""
    process = subprocess.Popen(
        command, cwd=cwd, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True, text=True, errors="replace",
    )  # fmt: skip
    try:
        out, err = process.communicate(timeout=timeout_s)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return subprocess.CompletedProcess(command, process.returncode, out, err)


# ---------------------------------------------------------------- user-mode Linux, from outside


def _run_in_uml(command: Sequence[str], cwd: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Boot user-mode Linux for one command, and halt it."""
    package = _user_mode_linux()
    with tempfile.TemporaryDirectory(prefix="aeroloop-uml-") as name:
        exchange = Path(name)
        for folder in ("uml", "tmp"):
            (exchange / folder).mkdir()
        (exchange / "python").symlink_to(os.path.realpath(sys.executable))
        request = {
            "command": list(command),
            "cwd": str(cwd.resolve()),
            "timeout_s": timeout_s,
            "env": {**os.environ, "TMPDIR": str(exchange / "tmp")},
            "hostname": socket.gethostname(),
            "modules": [str(found) for module in MODULES for found in package.rglob(f"{module}.ko")],
        }
        (exchange / "request.json").write_text(json.dumps(request))
        kernel = [
            *("taskset", "-c", "0"),  # between two processors each of its system calls takes three times as long
            *(str(package / "usr/bin/linux.uml"), "mem=512M", f"uml_dir={exchange}/uml"),
            *("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "devtmpfs.mount=0"),
            *("con=null", "con0=null,fd:1", "ssl=null", f'init="{exchange}/python"'),
            *("--", "-I", "-S", f'"{Path(__file__).resolve()}"', f'"{exchange}"'),
        ]
        env = {"PATH": os.defpath, "HOME": name, "TMPDIR": tempfile.gettempdir()}
        try:
            done = _run(kernel, exchange, BOOT_S + timeout_s, env)
            console = done.stderr + done.stdout
        except subprocess.TimeoutExpired as error:
            console = f"it did not halt within {error.timeout:g} s"
        started, said = (exchange / "started").exists(), exchange / "result.json"
        result: dict[str, Any] = json.loads(said.read_text()) if said.exists() else {"error": console}
    if "error" in result and not started:
        raise NoSocketCan(f"user-mode Linux did not get as far as SocketCAN: {_last_line(result['error'])}")
    if "error" in result:
        raise RuntimeError(f"user-mode Linux ended before its command did: {result['error']}")
    return subprocess.CompletedProcess(command, result["returncode"], result["stdout"], result["stderr"])


def _user_mode_linux() -> Path:
    """The unpacked package, from the cache or else from where this machine gets its packages."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aeroloop" / "uml"
    unpacked = cache / "root"
    if unpacked.exists():
        return unpacked
    apt, dpkg, why = shutil.which("apt-get"), shutil.which("dpkg-deb"), f"this kernel has no {INTERFACE}, and {PACKAGE}"
    if apt is None or dpkg is None or platform.machine() != "x86_64":
        raise NoSocketCan(f"{why} comes for Debian and Ubuntu on x86_64 only")
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as name:
        work = Path(name)
        for folder in ("lists/partial", "cache/archives/partial"):
            (work / folder).mkdir(parents=True)
        # This machine's lists may be missing or old, and not ours to change.
        options = ("APT::Sandbox::User=root", f"Dir::State::Lists={work}/lists", f"Dir::Cache={work}/cache")
        own = [apt, "-q", *(word for option in (*options, "Acquire::http::Timeout=30") for word in ("-o", option))]
        unpack = ["sh", "-c", f'"{dpkg}" -x *.deb root']
        for step in ([*own, "update"], [*own, "download", PACKAGE], unpack):
            try:
                done = _run(step, work, FETCH_S)
            except subprocess.TimeoutExpired:
                raise NoSocketCan(f"{why} took too long to get") from None
        if done.returncode:
            raise NoSocketCan(f"{why} cannot be had: {_last_line(done.stderr)}")
        with contextlib.suppress(OSError):  # another process was faster
            (work / "root").rename(unpacked)
    return unpacked


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it said nothing"])[-1]


# ---------------------------------------------------------------- Inside


def _libc(name: str, *arguments: int | bytes | None) -> None:
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


def _mount(kind: str, at: str, what: str = "") -> None:
    Path(at).mkdir(parents=True, exist_ok=True)
    _libc("mount", b"none", os.fsencode(at), kind.encode(), 0, os.fsencode(what))


def _be_init(exchange: Path) -> None:
    """Be process 1 of user-mode Linux: make ready, run the command, report its outcome, halt."""
    result: dict[str, Any] = {}
    try:
        request = json.loads((exchange / "request.json").read_text())
        kinds = {"/proc": "proc", "/sys": "sysfs", "/dev": "devtmpfs", "/dev/shm": "tmpfs", "/dev/pts": "devpts"}  # noqa: S108
        for at, kind in kinds.items():
            _mount(kind, at)
        for link, target in (("fd", ""), ("stdin", "/0"), ("stdout", "/1"), ("stderr", "/2")):
            Path("/dev", link).symlink_to(f"/proc/self/fd{target}")
        for folder in (request["cwd"], str(exchange)):
            _mount("hostfs", folder, folder)
        _mount("tmpfs", request["env"]["TMPDIR"])
        socket.sethostname(request["hostname"])
        for module in request["modules"]:
            with open(module, "rb") as file:
                finit_module = 313
                _libc("syscall", finit_module, file.fileno(), b"", 0)
        for words in (f"add {INTERFACE} type vcan", f"set {INTERFACE} mtu {FD_MTU} up", "set lo up"):
            subprocess.run(["/usr/sbin/ip", "link", *words.split()], check=True, capture_output=True, text=True)
        os.environ.clear()
        os.environ.update(request["env"])
        (exchange / "started").touch()
        done = _run(request["command"], Path(request["cwd"]), request["timeout_s"])
        result = {"returncode": done.returncode, "stdout": done.stdout, "stderr": done.stderr}
    except BaseException:
        result = {"error": traceback.format_exc()}
    finally:
        with contextlib.suppress(OSError):
            (exchange / "result.json").write_text(json.dumps(result))
        power_off = 0x4321FEDC
        os.sync()
        _libc("reboot", power_off)


if __name__ == "__main__":
    if os.getpid() == 1:
        _be_init(Path(sys.argv[1]))
