"""C code of a CasADi function, compiled once and kept: several times as fast as CasADi's virtual machine.

The library is named by the hash of its source, compiler and flags, in `$XDG_CACHE_HOME/aeroloop` (`~/.cache/aeroloop`),
and the newest KEPT stay. It ends in the hash of what comes before, which no loader reads: one that is cut off or
damaged is made anew, as loading it may end the process, or give other figures.
`-ffp-contract=off` keeps every rounding, so the bits are those of the virtual machine, which takes over wherever there
is no compiler, or it fails.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Final

import casadi as ca

FLAGS: Final = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
KEPT: Final = 64
_COMPILE_S: Final = 120.0
_HASH: Final = 32
"""Bytes of a SHA-256."""


def in_c(function: ca.Function) -> ca.Function | None:
    """The same function in C, compiled now or before; None where that fails."""
    library = shared_object_of(source_of(function))
    try:
        return ca.external(function.name(), str(library)) if library is not None else None
    except RuntimeError:  # not a library
        return None


def source_of(function: ca.Function) -> str:
    """C code of a function, which has its name."""
    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    source: str = generator.dump()
    return source


def shared_object_of(source: str) -> Path | None:
    """The library of C code, compiled now or before; None where that fails."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    try:
        built = Path(compiler).resolve().stat()
        identity = f"{compiler} {built.st_size} {built.st_mtime_ns} {FLAGS}\n{source}"
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aeroloop"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        library = folder / f"{sha256(identity.encode()).hexdigest()}.so"
        if _is_whole(library):
            os.utime(library)
        else:
            _compile(compiler, source, library)
    except (OSError, RuntimeError, subprocess.SubprocessError):  # RuntimeError: there is no home
        return None
    return library


def _is_whole(library: Path) -> bool:
    if not library.exists():
        return False
    made = library.read_bytes()
    return made[-_HASH:] == sha256(made[:-_HASH]).digest()


def _compile(compiler: str, source: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        code, made = Path(folder, "function.c"), Path(folder, "function.so")
        code.write_text(source)
        command = [compiler, *FLAGS, str(code), "-o", str(made), "-lm"]
        subprocess.run(command, check=True, capture_output=True, timeout=_COMPILE_S)  # noqa: S603  # found on PATH
        digest = sha256(made.read_bytes()).digest()
        with made.open("ab") as file:
            file.write(digest)
        made.replace(library)
    libraries = sorted(library.parent.glob("*.so"), key=lambda path: path.stat().st_mtime)
    for old in libraries[:-KEPT]:
        old.unlink(missing_ok=True)
