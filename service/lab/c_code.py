"""C code of a CasADi function, compiled by CasADi's own importer: several times as fast as its virtual machine.

`-ffp-contract=off` keeps every rounding, so the bits are those of the virtual machine, which takes over wherever there
is no compiler, or it fails.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import casadi as ca

FLAGS: Final = ("-O1", "-ffp-contract=off")


def in_c(function: ca.Function) -> ca.Function | None:
    """The same function in C; None where that fails."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    try:
        with TemporaryDirectory(prefix="aeroloop-") as folder:  # what is loaded stays, without its file
            source = Path(folder, generator.generate(f"{folder}/"))
            options: dict[str, Any] = {
                "compiler": compiler,
                "linker": compiler,
                "compiler_flags": FLAGS,
                "directory": f"{folder}/",
                "cleanup": False,  # the folder goes as a whole
            }
            return ca.external(function.name(), ca.Importer(str(source), "shell", options))
    except (OSError, RuntimeError):  # no place for files, or no library came of it
        return None
