"""SocketCAN kernel for a test's command, also on a machine whose kernel has none.

`run_with_socketcan` runs a command where `vcan0` is up and carries CAN FD: here, if it is; else in user-mode Linux, a
kernel that is an ordinary program, from the distribution's package `user-mode-linux`, which is downloaded and unpacked
into a cache the first time, not installed. It needs neither root nor hardware.

User-mode Linux boots on this machine's files, so the same interpreter and packages run inside. This file is its init:
the part under "Inside" runs there as process 1 and must import only the standard library. Inside there is no network
but `lo` and `vcan0`, one CPU, 512 MB, and root's rights over the user's files outside; files are read-only except for
the command's working directory and TMPDIR, which starts empty and is deleted afterwards. A process is several times
slower than outside, so only tests without real time run there.
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

INTERFACE = "vcan0"
FD_MTU = 72
"""sizeof(struct canfd_frame): an interface with this MTU carries both classic CAN and CAN FD."""

PACKAGE = "user-mode-linux"
MODULES = ("can-dev", "vcan", "can", "can-raw")
"""What SocketCAN needs, in the order in which they need each other."""

MEMORY_MIB = 512
SHM = "/dev/shm"  # noqa: S108 - the kernel checks what it finds there
FETCH_S = 300.0
"""For 40 MB of package, after 10 MB of package lists where there are none."""
BOOT_S = 60.0
"""Slack for booting and halting, beyond the command's own time: 2 s of CPU, and this machine may have other work."""


class NoSocketCan(Exception):  # noqa: N818 - it is a state of this machine, not an error
    """There is no SocketCAN on this machine and no way to get it; says why in one line."""


def run_with_socketcan(command: Sequence[str], cwd: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Run a command where `vcan0` is up and carries CAN FD.

    Args:
        command: What to run, with its arguments.
        cwd: Where to run it. It may write here, and in TMPDIR.
        timeout_s: How long it may take; making its kernel is not counted.

    Raises:
        NoSocketCan: Neither this machine nor user-mode Linux can do it.
        subprocess.TimeoutExpired: It took too long, and was killed.
        RuntimeError: Its kernel ended before it did.
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
    """Run a command without input, keep what it said, and leave none of its children behind.

    Raises:
        subprocess.TimeoutExpired: It took too long; with what it had said.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            command, cwd=cwd, env=env, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True
        )
        late = False
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            late = True
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        said = []
        for file in (out, err):
            file.seek(0)
            said.append(file.read().decode(errors="replace"))
    if late:
        raise subprocess.TimeoutExpired(command, timeout_s, *said)
    return subprocess.CompletedProcess(command, process.returncode, *said)


# -------------------------------------------------------------------------------- user-mode Linux, from outside


def _run_in_uml(command: Sequence[str], cwd: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Boot user-mode Linux for one command, and halt it."""
    package = _user_mode_linux()
    modules = [str(found) for name in MODULES for found in package.rglob(f"{name}.ko")]
    with tempfile.TemporaryDirectory(prefix="aeroloop-uml-") as name:
        exchange = Path(name)
        for folder in ("uml", "tmp"):
            (exchange / folder).mkdir()
        (exchange / "python").symlink_to(os.path.realpath(sys.executable))
        (exchange / "request.json").write_text(
            json.dumps(
                {
                    "command": list(command),
                    "cwd": str(cwd.resolve()),
                    "timeout_s": timeout_s,
                    "env": {**os.environ, "TMPDIR": str(exchange / "tmp")},
                    "hostname": socket.gethostname(),
                    "modules": modules,
                }
            )
        )
        kernel = [
            *("taskset", "-c", "0"),  # between two processors each of its system calls takes three times as long
            str(package / "usr/bin/linux.uml"),
            f"mem={MEMORY_MIB}M",
            f"uml_dir={exchange}/uml",
            *("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "devtmpfs.mount=0"),
            *("con=null", "con0=null,fd:1", "ssl=null"),
            f'init="{exchange}/python"',
            *("--", "-I", "-S", f'"{Path(__file__).resolve()}"', f'"{exchange}"'),
        ]
        roomy = shutil.disk_usage(SHM).free >= MEMORY_MIB * 2**20  # for the file that is the inner machine's memory
        env = {"PATH": os.defpath, "HOME": name, "TMPDIR": SHM if roomy else tempfile.gettempdir()}
        try:
            done = _run(kernel, exchange, BOOT_S + timeout_s, env)
            console = done.stderr + done.stdout
        except subprocess.TimeoutExpired as error:
            if not (exchange / "started").exists():
                raise NoSocketCan(f"user-mode Linux did not boot within {error.timeout:g} s") from None
            console = f"it did not halt within {error.timeout:g} s"
        started, said = (exchange / "started").exists(), exchange / "result.json"
        result: dict[str, Any] = json.loads(said.read_text()) if said.exists() else {"error": _last_line(console)}
    if "error" in result:
        if not started:
            raise NoSocketCan(f"user-mode Linux did not get as far as SocketCAN: {_last_line(result['error'])}")
        raise RuntimeError(f"user-mode Linux ended before its command did: {result['error']}")
    if result["returncode"] is None:
        raise subprocess.TimeoutExpired(command, timeout_s, result["stdout"], result["stderr"])
    return subprocess.CompletedProcess(command, result["returncode"], result["stdout"], result["stderr"])


def _user_mode_linux() -> Path:
    """The unpacked package, from the cache or else from where this machine gets its packages.

    Raises:
        NoSocketCan: It cannot be had here.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aeroloop" / "uml"
    unpacked = cache / "root"
    if unpacked.exists():
        return unpacked
    apt, dpkg = shutil.which("apt-get"), shutil.which("dpkg-deb")
    if apt is None or dpkg is None or platform.machine() != "x86_64":
        raise NoSocketCan(f"this kernel has no vcan0, and {PACKAGE} comes for Debian and Ubuntu on x86_64 only")
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as name:
        work = Path(name)
        for folder in ("lists/partial", "cache/archives/partial"):
            (work / folder).mkdir(parents=True)
        # This machine's lists may be missing or old, and not ours to change.
        options = ("APT::Sandbox::User=root", f"Dir::State::Lists={work}/lists", f"Dir::Cache={work}/cache")
        own = (apt, "-q", *(word for option in (*options, "Acquire::http::Timeout=30") for word in ("-o", option)))
        try:
            for step in ((*own, "update"), (*own, "download", PACKAGE)):
                done = _run(step, work, FETCH_S)
            packages = [*work.glob("*.deb")]
            if packages:
                done = _run((dpkg, "-x", str(packages[0]), str(work / "root")), work, FETCH_S)
        except subprocess.TimeoutExpired:
            raise NoSocketCan(f"this kernel has no vcan0, and getting {PACKAGE} took too long") from None
        if done.returncode:
            raise NoSocketCan(f"this kernel has no vcan0, and {PACKAGE} cannot be had: {_last_line(done.stderr)}")
        with contextlib.suppress(OSError):  # another process was faster
            (work / "root").rename(unpacked)
    return unpacked


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it said nothing"])[-1]


# -------------------------------------------------------------------------------- Inside


def _libc(name: str, *arguments: int | bytes | None) -> None:
    """Call a function of the C library that says with −1 that it failed.

    Raises:
        OSError: It failed.
    """
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    if function(*arguments) < 0:
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


def _set_link_up(name: str, kind: str | None = None, mtu: int | None = None) -> None:
    """`ip link add name type kind mtu mtu up`, or without a kind `ip link set name up`; there may be no ip here.

    Raises:
        OSError: The kernel refused.
    """
    rtm_newlink, nlm_f_request, nlm_f_ack, nlm_f_excl, nlm_f_create, iff_up = 16, 0x1, 0x4, 0x200, 0x400, 1
    ifla_ifname, ifla_mtu, ifla_linkinfo, ifla_info_kind = 3, 4, 18, 1

    def attribute(number: int, value: bytes) -> bytes:
        return struct.pack("=HH", 4 + len(value), number) + value + bytes(-len(value) % 4)

    body = struct.pack("=BxHiII", socket.AF_UNSPEC, 0, 0, iff_up, iff_up) + attribute(
        ifla_ifname, name.encode() + b"\0"
    )
    flags = nlm_f_request | nlm_f_ack
    if mtu is not None:
        body += attribute(ifla_mtu, struct.pack("=I", mtu))
    if kind is not None:
        body += attribute(ifla_linkinfo, attribute(ifla_info_kind, kind.encode()))
        flags |= nlm_f_create | nlm_f_excl
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(struct.pack("=IHHII", 16 + len(body), rtm_newlink, flags, 1, 0) + body)
        (error,) = struct.unpack_from("=i", netlink.recv(65536), 16)
    if error:
        raise OSError(-error, f"{name}: {os.strerror(-error)}")


def _set_links_up() -> None:
    _set_link_up("lo")
    _set_link_up(INTERFACE, kind="vcan", mtu=FD_MTU)
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()


def _be_init(exchange: Path) -> None:
    """Be process 1 of user-mode Linux: make ready, run the command, report its outcome, halt."""
    result: dict[str, Any] = {}
    try:
        request = json.loads((exchange / "request.json").read_text())
        for kind, at in (("proc", "/proc"), ("sysfs", "/sys"), ("devtmpfs", "/dev")):
            _mount(kind, at)
        for kind, at in (("tmpfs", "/dev/shm"), ("devpts", "/dev/pts")):  # noqa: S108 - a mount point
            _mount(kind, at)
        for link, target in (("fd", ""), ("stdin", "/0"), ("stdout", "/1"), ("stderr", "/2")):
            Path("/dev", link).symlink_to(f"/proc/self/fd{target}")
        _mount("hostfs", request["cwd"], request["cwd"])
        _mount("hostfs", str(exchange), str(exchange))
        _mount("tmpfs", request["env"]["TMPDIR"])
        socket.sethostname(request["hostname"])
        for module in request["modules"]:
            with open(module, "rb") as file:
                finit_module = 313
                _libc("syscall", finit_module, file.fileno(), b"", 0)
        _set_links_up()
        os.environ.clear()
        os.environ.update(request["env"])
        (exchange / "started").touch()
        try:
            done = _run(request["command"], Path(request["cwd"]), request["timeout_s"])
            result = {"returncode": done.returncode, "stdout": done.stdout, "stderr": done.stderr}
        except subprocess.TimeoutExpired as late:
            result = {"returncode": None, "stdout": late.output, "stderr": late.stderr}
    except BaseException:
        result = {"error": traceback.format_exc()}
    finally:
        with contextlib.suppress(OSError):
            (exchange / "result.json").write_text(json.dumps(result))
        power_off = 0x4321FEDC
        os.sync()
        _libc("reboot", power_off)


def _mount(kind: str, at: str, what: str = "") -> None:
    Path(at).mkdir(parents=True, exist_ok=True)
    _libc("mount", b"none", os.fsencode(at), kind.encode(), 0, os.fsencode(what))


if __name__ == "__main__":
    if os.getpid() == 1:
        _be_init(Path(sys.argv[1]))
