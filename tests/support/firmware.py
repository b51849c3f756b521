"""The firmware's C in this process: compiled as a library for one configuration."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import config_header
from aeroloop.service.firmware.machines import EXACT

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
NO_COMPILER = "no C compiler: neither gcc nor clang"
SOURCE = Path(str(files("aeroloop.service.firmware"))) / "c"
_STRICT = ["-std=c99", "-Os", *EXACT, "-Wall", "-Wextra", "-Wconversion", "-Werror", "-shared", "-fPIC"]


def library(
    settings: Settings, folder: Path, *sources: Path, compiler: str = "", may_warn: bool = False
) -> ctypes.CDLL:
    """Compile sources, with `aero_config.h` of the settings in a folder, and load them. Only CasADi's code may warn."""
    (folder / "aero_config.h").write_text(config_header(settings))
    made = folder / "firmware.so"
    words = [f"-I{folder}", f"-I{SOURCE}", "-o", str(made), *map(str, sources), "-lm"]
    if may_warn:
        words.append("-w")
    subprocess.run([compiler or COMPILERS[0], *_STRICT, *words], check=True)
    return ctypes.CDLL(str(made))
