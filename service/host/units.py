"""systemd units for the daemons, written from one template, so that the three stay alike.

`Type=notify`: a daemon notifies systemd when it is ready, once a second while it runs, and when it stops. The sandbox
allows the network, the configuration and, for the recorder, its logs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

UNITS: Final = {
    "controller": ("the adaptive attitude controller", "controller", True),
    "plant": ("the plant end that plant.via names", "plant", True),
    "recorder": ("the recorder of everything on the network", "recorder --set recorder.directory=%L/aeroloop", False),
}
"""By unit: description, command, and whether its loop is timed."""

_TEMPLATE: Final = """\
[Unit]
Description=aeroloop: {what}
After=network-online.target
Wants=network-online.target

[Service]
Type=notify
ExecStart={executable} {command} --config /etc/aeroloop/aeroloop.toml --log-format json
ExecReload=/bin/kill -HUP $MAINPID
Restart=on-failure
RestartSec=1
WatchdogSec=5
TimeoutStopSec=10
DynamicUser=yes
{rights}
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
PrivateDevices=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX
RestrictNamespaces=yes
LockPersonality=yes
SystemCallArchitectures=native

[Install]
WantedBy=multi-user.target
"""
_TIMED: Final = "LimitRTPRIO=20\nLimitMEMLOCK=infinity\nCapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK"
_UNTIMED: Final = "LogsDirectory=aeroloop\nCapabilityBoundingSet="


def unit(name: str, executable: str) -> str:
    """The unit of one daemon. Raises KeyError for a name that is not in `UNITS`."""
    what, command, timed = UNITS[name]
    return _TEMPLATE.format(what=what, executable=executable, command=command, rights=_TIMED if timed else _UNTIMED)


def install(folder: Path, executable: str) -> list[Path]:
    """Write every unit into a folder and return their paths. Raises OSError if it cannot be written."""
    paths = {name: folder / f"aeroloop-{name}.service" for name in UNITS}
    for name, path in paths.items():
        path.write_text(unit(name, executable))
    return list(paths.values())
