"""CasADi and NumPy, imported at their first use: reading a configuration or a message must not wait for them.

They take 0.15 s of a core and 47 MB. `aeroloop show` and the recorder read the settings of law and plant, which
stand beside their equations, and compute nothing. What settings and messages are read with imports them from here.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import casadi as casadi
    import numpy as numpy
else:

    class _Lazy:
        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            value = getattr(import_module(self._name), attribute)
            setattr(self, attribute, value)  # the next use costs what a module's does
            return value

    casadi, numpy = _Lazy("casadi"), _Lazy("numpy")
