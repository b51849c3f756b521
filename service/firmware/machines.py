"""Machines: compiles the exported controller for a processor, and runs it here: as it is, or in QEMU."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

from aeroloop.service.control.controller import Controller
from aeroloop.service.firmware.export import ExportError, export
from aeroloop.service.firmware.script import ScriptedController, answers_in
from aeroloop.service.logs.recording import Progress
from aeroloop.service.logs.replay import Answering
from aeroloop.service.logs.ticks import LoggedController


class Machine(NamedTuple):
    """How programs for a processor are compiled and started here. `packages` are Debian's."""

    compiler: str
    flags: tuple[str, ...] = ()
    start: tuple[str, ...] = ()  # before the program's file
    packages: str = ""


_SEMIHOSTED: Final = "enable=on,target=native,arg=test_golden"
MACHINES: Final[dict[str, Machine]] = {
    "host": Machine("cc", packages="gcc make"),
    "aarch64": Machine(
        "aarch64-linux-gnu-gcc",
        ("-static",),
        ("qemu-aarch64",),
        "gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user make",
    ),
    "cortex-m4": Machine(
        "arm-none-eabi-gcc",
        ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
        ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting-config", _SEMIHOSTED, "-kernel"),
        "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm make",
    ),
}
"""Processors by name. A Cortex-M4F has double precision in software only."""
EXACT: Final = ("-ffp-contract=off", "-fno-tree-slp-vectorize")
"""Compiler's flags that keep every rounding; the Makefile has them, too."""
_BARE: Final = ("--specs=rdimon.specs", "-Tcortex_m.ld", "cortex_m.c")  # to link a program for no system


def compiled(sources: Sequence[Path], out: Path, *flags: str) -> Path:
    """Compile sources, with the headers beside them, for this machine. Raises ExportError."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ExportError("this needs a C compiler: cc, gcc or clang")
    words = [compiler, "-std=c99", "-O1", *EXACT, *flags, *map(str, sources), "-o", str(out), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603  # ours
    if done.returncode:
        raise ExportError(f"{out.name} does not compile: {(done.stderr.splitlines() or ['no message'])[0]}")
    return out


class Program:
    """The controller of an exported configuration, compiled in a folder. Raises ExportError without a compiler."""

    def __init__(self, folder: Path, machine: str) -> None:
        self.folder, self._machine = folder, MACHINES[machine]
        programs = [self._machine.compiler, "make", *self._machine.start[:1]]
        if missing := [program for program in programs if shutil.which(program) is None]:
            raise ExportError(f"no {missing[0]} here, for --machine {machine}: install {self._machine.packages}")
        link = _BARE if machine == "cortex-m4" else ()
        flags = " ".join(self._machine.flags)
        self._run(
            "make", "--silent", "test_golden", f"CC={self._machine.compiler}", f"CPPFLAGS={flags}",
            f"LDFLAGS={' '.join([flags, *link])}",
        )  # fmt: skip

    def answers(self, script: bytes) -> bytes:
        """What it answers a script. Raises ExportError if it fails."""
        (self.folder / "script.bin").write_bytes(script)
        self._start("script.bin", "answers.bin")
        return (self.folder / "answers.bin").read_bytes()

    def golden(self) -> str:
        """Its one line on the golden commands. Raises ExportError if one differs."""
        return self._start()

    def _start(self, *words: str) -> str:
        start = self._machine.start
        if _SEMIHOSTED in start:
            listed = _SEMIHOSTED + "".join(f",arg={word}" for word in words)
            return self._run(*(listed if part == _SEMIHOSTED else part for part in start), "test_golden")
        return self._run(*start, "./test_golden", *words)

    def _run(self, *command: str) -> str:
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)  # noqa: S603  # ours
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
            raise ExportError(f"{command[0]} failed: {said[0]}")
        return done.stdout.strip()


class InC(Answering):
    """A controller's rows, answered by the exported C on a machine."""

    made_by: type[Controller] = ScriptedController

    def __init__(self, machine: str) -> None:
        self._machine = machine

    def answers(self, logged: LoggedController, progress: Progress | None) -> Iterator[bytes | None]:
        """As the controller's. Raises ExportError if it cannot be compiled, or computes other voltages."""
        controller = logged.controller
        assert isinstance(controller, ScriptedController)
        asked = [controller.asked for _ in logged.answers(progress)]
        with TemporaryDirectory(prefix="aeroloop-") as name:
            export(logged.settings, Path(name))
            found, digest = answers_in(Program(Path(name), self._machine).answers(bytes(controller.script)))
        for before, after in pairwise([0, *asked]):
            yield found[before] if after > before else None
        if digest != controller.digest:
            raise ExportError(f"on {self._machine} the law does not compute the voltages of the log, to the last bit")
