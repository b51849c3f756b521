"""systemd units for the daemons, written from one template for the configured plant.

The sandbox allows what the configuration needs: the network, the plant's bus or device, the folders of interpreter and
configuration, and the recorder's logs.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.runtime.realtime import PRIORITY
from aeroloop.protocol.transport.network_settings import Endpoint, NetworkSettings
from aeroloop.service.config import Settings

CONFIG: Final = Path("/etc/aeroloop/aeroloop.toml")
SYSTEM_FOLDER: Final = Path("/etc/systemd/system")
FIREWALL: Final = "aeroloop.nft"
UNITS: Final = {
    "router": "the router that all others connect to",
    "recorder": "the recorder of everything on the network",
    "plant": "the plant end that plant.via names",
    "controller": "the adaptive attitude controller",
}
"""Daemon to description, in the order of start."""
_HOMES: Final = (Path("/home"), Path("/root"), Path("/run/user"))
"""What `ProtectHome=` hides."""
_WITHOUT_DEVICE: Final = ("socketcan", "socketcand", "udp_multicast", "virtual")
"""python-can's interfaces that open no device file."""

_TEMPLATE: Final = """\
# For plant.via = "{via}", by `aeroloop host units`; your own changes go to `systemctl edit`.
[Unit]
Description=aeroloop: {what}
After=network-online.target
Wants=network-online.target

[Service]
Type=notify
ExecStart={command}
Restart=on-failure
RestartSec=1
WatchdogSec=5
TimeoutStopSec=10
{rights}
NoNewPrivileges=yes
ProtectSystem=strict
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
RestrictNamespaces=yes
LockPersonality=yes
SystemCallArchitectures=native

[Install]
WantedBy=multi-user.target
"""


NEW_PER_S: Final = 2
NEW_BURST: Final = 10
_FIREWALL: Final = """\
# Limits new connections by address and port, for `nft -f`: at most {per_s} a second after a burst of {burst}.
table inet aeroloop
delete table inet aeroloop
table inet aeroloop {{
  set newcomers {{ type ipv4_addr . inet_proto . inet_service; flags dynamic; timeout 1m; size 65535; }}
  set newcomers6 {{ type ipv6_addr . inet_proto . inet_service; flags dynamic; timeout 1m; size 65535; }}
  chain input {{
    type filter hook input priority filter; policy accept;
    meta l4proto {{ tcp, udp }} th dport {{ {ports} }} ct state new update @newcomers \\
      {{ ip saddr . meta l4proto . th dport limit rate over {per_s}/second burst {burst} packets }} drop
    meta l4proto {{ tcp, udp }} th dport {{ {ports} }} ct state new update @newcomers6 \\
      {{ ip6 saddr . meta l4proto . th dport limit rate over {per_s}/second burst {burst} packets }} drop
  }}
}}
"""
"""A failed handshake keeps Zenoh's listener from accepting for 0.1 s: two a second leave it most of its time."""


class UnitError(AeroloopError):
    """The units cannot be written; one line."""


class Source(NamedTuple):
    """How the daemons are started: their configuration file, `--set` words beside it, and what both make."""

    config: Path
    overrides: Sequence[str]
    settings: Settings

    @property
    def options(self) -> list[str]:
        """The options that name file and words on a command line."""
        return ["--config", str(self.config.absolute()), *(word for each in self.overrides for word in ("--set", each))]


def units_of(settings: Settings) -> list[str]:
    """Names of the units of a configuration: only clients need a router."""
    return [name for name in UNITS if name != "router" or settings.network.mode == "client"]


def unit(name: str, source: Source) -> str:
    """The unit of one daemon. Raises KeyError for a name that is not in `UNITS`."""
    first, last, rights = list[str](), list[str](), _user(source)
    families, devices = list[str](), ["PrivateDevices=yes"]
    if name == "plant":
        # systemd starts a plant again by itself, so it is unarmed then; a --set of the user's own comes later and wins.
        first = ["--set", "plant.armed_at_start=false"]
        configured = source.settings.plant.state_directory
        rights.append(f"ReadWritePaths={_quoted(str(configured))}" if configured else "StateDirectory=aeroloop")
        families, devices = _access(source.settings)
    if name == "recorder":
        last = ["--set", "recorder.path=%L/aeroloop"]
        rights.append("LogsDirectory=aeroloop")
    if name in ("plant", "controller"):
        capabilities = "CAP_SYS_NICE CAP_IPC_LOCK"
        rights += [f"LimitRTPRIO={PRIORITY}", "LimitMEMLOCK=infinity"]
    else:
        capabilities = ""
    # Netlink lists this host's addresses, for peers on other hosts.
    families = ["AF_INET AF_INET6 AF_UNIX AF_NETLINK", *families]
    rights += [f"CapabilityBoundingSet={capabilities}", *devices, f"RestrictAddressFamilies={' '.join(families)}"]
    words = [*_executable(), name, *first, *source.options, *last]
    return _TEMPLATE.format(
        via=source.settings.plant.via, what=UNITS[name], command=" ".join(map(_quoted, words)), rights="\n".join(rights)
    )


def install(folder: Path, source: Source) -> list[Path]:
    """Write every unit into a folder, over an older one, and the firewall's rules if any; return their paths.

    Raises UnitError if it cannot.
    """
    texts = {folder / f"aeroloop-{name}.service": unit(name, source) for name in units_of(source.settings)}
    rules = firewall(source.settings.network)
    if rules:
        texts[folder / FIREWALL] = rules
    try:
        for path, text in texts.items():
            path.write_text(text)
    except OSError as error:
        raise UnitError(f"cannot write into {folder}: {error.strerror}") from None
    return list(texts)


def firewall(network: NetworkSettings) -> str:
    """Rules of nftables that limit new connections to each port, for every host; empty where none goes beyond loopback.

    By address and port: an operator's commands try several ports at once, and each has its own limit.
    """
    endpoints = [Endpoint.parse(text) for text in (*network.rendezvous_endpoints, *network.listen)]
    ports = sorted({place.port for place in endpoints if place.leaves_host and place.port})
    if not ports:
        return ""
    ranges: list[list[int]] = []  # first and last of consecutive ports
    for port in ports:
        if ranges and ranges[-1][1] == port - 1:
            ranges[-1][1] = port
        else:
            ranges.append([port, port])
    listed = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)
    return _FIREWALL.format(ports=listed, per_s=NEW_PER_S, burst=NEW_BURST)


def next_steps(folder: Path | None, source: Source) -> list[str]:
    """Commands that remain after `install` into a folder (None: the units were printed) until the daemons run."""
    hidden = [path for path in (Path(_executable()[0]), source.config.absolute()) if path.is_relative_to("/tmp")]  # noqa: S108
    steps = [
        f"# {path} is in /tmp, which units do not see (PrivateTmp=): move it, to /opt for example" for path in hidden
    ]
    if not source.config.exists():
        steps.append(f"sudo mkdir -p {source.config.parent}")
        steps.append(f"aeroloop show config | sudo tee {source.config} >/dev/null")
    if folder is None:
        command = [*_executable(), "host", "units", "--install", str(SYSTEM_FOLDER), *source.options]
        steps.append(f"sudo {shlex.join(command)}")
    elif folder.absolute() != SYSTEM_FOLDER:
        steps.append(f"sudo cp {shlex.quote(str(folder))}/aeroloop-*.service {SYSTEM_FOLDER}/")
    if firewall(source.settings.network):
        rules = shlex.quote(str((folder or SYSTEM_FOLDER).absolute() / FIREWALL))
        steps.append(f"sudo nft -f {rules}  # against floods of connections; to last, include it in /etc/nftables.conf")
    names = " ".join(f"aeroloop-{name}" for name in units_of(source.settings))
    return [*steps, "sudo systemctl daemon-reload", f"sudo systemctl enable --now {names}", "aeroloop op status"]


def _executable() -> list[str]:
    """The command of the interpreter that runs now."""
    script = Path(sys.executable).with_name("aeroloop")
    return [str(script)] if script.exists() else [sys.executable, "-P", "-m", "aeroloop"]


def _quoted(word: str) -> str:
    """A word of ExecStart=: systemd.service(5) expands $ and splits at blanks; `%L` alone is meant as a specifier."""
    escaped = word.replace("$", "$$")
    if "%L" not in word:
        escaped = escaped.replace("%", "%%")
    if escaped == word and not set(word) & set(" \t\"'\\;"):
        return escaped
    return '"' + escaped.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _user(source: Source) -> list[str]:
    """Lines on the user: one of systemd's own, unless something it needs is in a home, or keys are another user's."""
    keys = source.settings.network.security.folder
    needed = (Path(sys.prefix), Path(sys.base_prefix), Path(__file__).resolve(), source.config.absolute(), keys)
    homes = [path for path in needed if path and any(path.is_relative_to(home) for home in _HOMES)]
    protected = "ProtectHome=read-only" if homes else "ProtectHome=yes"
    if keys is not None and keys.exists():
        return [f"# The keys in {keys} are its owner's alone.", f"User={keys.owner()}", protected]
    if not homes:
        return ["DynamicUser=yes", protected]
    why = f"# {homes[0]} is in a home, so its owner runs the daemon; installed under /opt, it gets a user of its own."
    return [why, f"User={homes[0].owner()}", protected]


def _access(settings: Settings) -> tuple[list[str], list[str]]:
    """Address families and lines on devices that the plant end needs besides the network's."""
    via, can = settings.plant.via, settings.can
    if via == "can" and can.interface == "socketcan":
        return ["AF_CAN"], ["PrivateDevices=yes"]
    if via == "emulator" or (via == "can" and can.interface in _WITHOUT_DEVICE):
        return [], ["PrivateDevices=yes"]
    if via == "can" and can.channel.startswith("/dev/"):
        device = Path(can.channel.partition("@")[0])
        group = device.group() if device.exists() else "dialout"
        return [], ["DevicePolicy=closed", f"DeviceAllow={device} rw", f"SupplementaryGroups={group}"]
    comment = "# USB; its user also needs write access to /dev/bus/usb, as a udev rule gives it."
    return [], [comment, "DevicePolicy=closed", "DeviceAllow=char-usb_device rw"]
