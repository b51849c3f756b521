"""Node in C on this machine: its program with the emulated plant behind it, written into a folder, compiled and run."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.transport.can_format import check_widths
from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import config_header
from aeroloop.service.firmware.export import SOURCES, ExportError
from aeroloop.service.firmware.machines import compiled
from aeroloop.service.firmware.plant import write_plant

_NOTICE_S = 0.05  # how long the end of the program, or a request to stop, may go unnoticed [s]


def build(settings: Settings, folder: Path) -> Path:
    """Write the sources of a node with the emulated plant into a folder and compile them. Returns the program.

    Raises:
        CanError: A frame does not fit the bus.
        PlantError: The plant is none of the emulated bodies.
        ExportError: The plant has what the C lacks: faults, wind or noise; or there is no compiler, or it fails.
    """
    check_widths(settings.can, settings.wire)
    for name in ("aero_float", "aero_wire", "aero_node", "aero_port", "linux/aero_linux"):
        for source in SOURCES.glob(f"{name}.[ch]"):
            shutil.copy(source, folder)
    (folder / "aero_config.h").write_text(config_header(settings), encoding="ascii")
    parts = [folder / f"{name}.c" for name in ("aero_wire", "aero_node", "aero_linux")]
    return compiled([*parts, *write_plant(settings, folder)], folder / "aero_node")


def run(settings: Settings, stop: Event) -> None:
    """Compile the node and run it until `stop` is set. Raises as `build`, and ExportError if the program fails."""
    bus, options = settings.can, settings.can.options
    where = [bus.interface, bus.channel]
    if bus.interface == "udp_multicast":
        where += [str(options.get("port", 43113)), str(options.get("hop_limit", 1))]  # python-can's defaults
    elif bus.interface != "socketcan":
        raise ExportError(f"the node in C runs on socketcan and udp_multicast, not on {bus.interface}")
    with TemporaryDirectory(prefix="aeroloop-") as folder:
        program = build(settings, Path(folder))
        if not settings.loop.lockstep:
            prepare_process(settings.loop)  # which the program inherits
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        # It ends when this process does, which closes the pipe.
        with subprocess.Popen([program, *where], **pipes) as process:  # noqa: S603  # settings, no shell
            while process.poll() is None and not stop.wait(_NOTICE_S):
                pass
            process.terminate()
            _, said = process.communicate()
    if process.returncode:
        raise ExportError(f"the node in C ended with exit code {process.returncode}: {said.strip()}")
