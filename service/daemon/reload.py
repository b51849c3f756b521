"""Reload on SIGHUP: reads the configuration again and applies the keys that may change while a daemon runs.

A key that needs a restart is named in the event and keeps its value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from aeroloop.protocol.runtime.role import Action, Role
from aeroloop.protocol.wire.spec import flat
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import law_class

LIVE: Final = {
    "controller": (
        "reference",
        "controller.stale_s",
        "controller.law_timeout_s",
        "controller.telemetry_rate_hz",
        "controller.max_reference_rate",
        "controller.max_reference_braking",
        "controller.max_reference_tilt_deg",
        "controller.auto_arm",
        "controller.after_restart",
        "controller.require_certificate",
    ),
    "plant": ("plant.limits", "plant.watchdog_s", "plant.truth_rate_hz"),
    "recorder": ("recorder.chunk_s", "recorder.max_file_mb", "recorder.max_file_s", "recorder.keep_gb"),
    "router": (),
}
"""By role, the keys and sections that take effect at once; a controller's gains, too."""

_SECTIONS: Final = {
    "controller": {"vehicle", "loop", "wire", "law", "reference", "controller", "network"},
    "plant": {"vehicle", "loop", "wire", "plant", "network"},
    "recorder": {"vehicle", "recorder", "network"},
    "router": {"vehicle", "network"},
}
"""By role, the sections that it uses."""


_MOST_SHOWN: Final = 8
"""Elements of a list that are shown."""


def reload_on_hangup(
    role: Role,
    settings: Settings,
    load: Callable[[], Settings],
    take_over: Callable[[Settings], None],
    certificate_of: Callable[[dict[str, Any]], dict[str, Any] | None] = lambda _: None,
) -> None:
    """Reload the configuration on SIGHUP.

    Args:
        role: The daemon's presence on the network.
        settings: Its present configuration.
        load: Reads it again; raises ConfigError.
        take_over: Called with the new configuration between two ticks; applies what is in `LIVE`.
        certificate_of: Returns the certificate of an effective configuration, for the description. Raises an
            AeroloopError where the theorem must hold and does not; then nothing changes.
    """
    current, effective = settings, settings.description()

    def reload() -> Action:
        nonlocal current, effective
        now = load()
        lines = differences(current, now, role.role)
        description = _with_live_keys(effective, now.description(), live_keys(role.role, current.law))
        certificate = certificate_of(description)
        current, effective = now, description

        def apply() -> None:
            take_over(now)
            # The description holds effective values only: a log must not contain those that need a restart.
            role.publish_description(description, certificate)
            role.event("changed", f"configuration read again: {'; '.join(lines) or 'nothing has changed'}")

        return apply

    role.on_hangup(reload)


def live_keys(role: str, law: LawSettings) -> tuple[str, ...]:
    """The keys and sections that take effect at once in a role with this law."""
    return LIVE[role] + (tuple(f"law.{name}" for name in law_class(law).gains) if role == "controller" else ())


def _with_live_keys(effective: dict[str, Any], after: dict[str, Any], live: tuple[str, ...]) -> dict[str, Any]:
    """The effective configuration with the live keys of a new one."""
    merged = {**effective}
    for name in live:
        section, _, key = name.partition(".")
        merged[section] = {**merged[section], key: after[section][key]} if key else after[section]
    return merged


def differences(before: Settings, after: Settings, role: str) -> list[str]:
    """The changes for a role, a line per key: old value, new value, and whether it needs a restart."""
    old, new = (flat(settings.model_dump(mode="json", include=_SECTIONS[role])) for settings in (before, after))
    live = tuple(f"{name}." for name in live_keys(role, before.law))
    return [
        f"{key}: {_short(old.get(key))} → {_short(new.get(key))}"
        + ("" if f"{key}.".startswith(live) else ", after a restart")
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
    ]


def _short(value: object) -> str:
    """A value in a line: the points of a reference may be thousands."""
    return f"{len(value)} values" if isinstance(value, list) and len(value) > _MOST_SHOWN else str(value)
