"""Adaptive attitude control over Eclipse Zenoh, in frames whose every bit is a quantizer's bit.

The public Python API. Everything else under `aeroloop` may change without notice.

    import aeroloop

    settings = aeroloop.load_settings(overrides={"wire.voltage.bits": 8})
    figures = aeroloop.run_experiment(settings, duration_s=10)
    print(figures.z_track, aeroloop.certify(settings).verdict)

Examples are in `aeroloop/service/examples`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aeroloop.research import *  # noqa: F403  # the public names


def __getattr__(name: str) -> Any:
    """A public name, loaded at the first use of any: `import aeroloop` stays light, and so does every command."""
    from importlib import import_module

    if name == "__all__" or not name.startswith("_"):
        public = import_module("aeroloop.research")
        if name == "__all__" or name in public.__all__:
            return getattr(public, name)
    raise AttributeError(f"module 'aeroloop' has no attribute {name!r}")


def __dir__() -> list[str]:
    names: list[str] = __getattr__("__all__")
    return names
