"""SIGHUP: the configuration read again, and what of it can change while a daemon runs.

What cannot is named, and stays as it was until a restart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from aeroloop.protocol.runtime.role import Action, Role
from aeroloop.service.config import Settings

LIVE: Final = {
    "controller": (
        "law.C1",
        "law.C2",
        "law.Gamma",
        "reference",
        "controller.stale_s",
        "controller.telemetry_rate_hz",
        "controller.max_reference_rate",
        "controller.max_reference_tilt_deg",
        "controller.auto_arm",
        "controller.require_certificate",
    ),
    "plant": ("plant.limits", "plant.watchdog_s", "plant.truth_rate_hz"),
    "recorder": ("recorder.chunk_s", "recorder.max_file_mb", "recorder.max_file_s", "recorder.keep_gb"),
}
"""By role, the keys and sections that take effect at once."""

_SECTIONS: Final = {
    "controller": ("vehicle", "loop", "wire", "law", "reference", "controller", "network"),
    "plant": ("vehicle", "loop", "wire", "plant", "network"),
    "recorder": ("vehicle", "recorder", "network"),
}
"""By role, what concerns it at all."""


def reload_on_hangup(
    role: Role,
    settings: Settings,
    load: Callable[[], Settings],
    take_over: Callable[[Settings], None],
    promise: Callable[[dict[str, Any]], dict[str, Any] | None] = lambda _: None,
) -> None:
    """Let SIGHUP read the configuration again.

    Args:
        role: Who.
        settings: Its configuration so far.
        load: Reads it again; raises ConfigError.
        take_over: Given the new configuration between two ticks, takes what is in `LIVE`.
        promise: What the theorem promises of an effective configuration, for the description; raises an AeroloopError
            where it must hold and does not, and nothing changes.
    """
    current = settings
    effective = settings.description()

    def reload() -> Action:
        nonlocal current, effective
        before, now = current, load()
        lines = differences(before, now, role.role)
        description = _with_what_is_live(effective, now.description(), role.role)
        promised = promise(description)
        current, effective = now, description

        def take() -> None:
            take_over(now)
            # What needs a restart is not in effect, and a log must not say so.
            role.configured(description, promised)
            role.event("changed", f"configuration read again: {'; '.join(lines) or 'nothing has changed'}")

        return take

    role.on_hangup(reload)


def _with_what_is_live(effective: dict[str, Any], after: dict[str, Any], role: str) -> dict[str, Any]:
    """A configuration with what takes effect at once of another one."""
    merged = {**effective}
    for name in LIVE[role]:
        section, _, key = name.partition(".")
        merged[section] = {**merged[section], key: after[section][key]} if key else after[section]
    return merged


def differences(before: Settings, after: Settings, role: str) -> list[str]:
    """What has changed for a role, one line a key: from what, to what, and whether it needs a restart."""
    old, new = (_flat(settings.description(), _SECTIONS[role]) for settings in (before, after))
    lines = []
    for key in sorted(old.keys() | new.keys()):
        if old.get(key) != new.get(key):
            live = any(key == name or key.startswith(f"{name}.") for name in LIVE[role])
            line = f"{key}: {old.get(key)} → {new.get(key)}"
            lines.append(line if live else f"{line}, after a restart")
    return lines


def _flat(tree: dict[str, Any], sections: tuple[str, ...], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        if not prefix and name not in sections:
            continue
        if isinstance(value, dict):
            leaves |= _flat(value, sections, f"{prefix}{name}.")
        else:
            leaves[prefix + name] = value
    return leaves
