"""Descriptions of roles, and the configuration of a session made of them: each section from the role that owns it.

Every process is configured by itself, so that the controller's copy of `plant.mass` may differ from the plant's. What
holds is the copy of the role that acts by it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.topics import Address
from aeroloop.service.config import Settings, from_description

OWNED: Final = {"plant": ("plant", "can"), "recorder": ("recorder",)}
"""Sections by the role that owns them; the others are the controller's."""


def read_description(text: bytes, address: Address | None) -> Description:
    """Parse a description, recorded under a key.

    Raises:
        ValueError: It is malformed, of another role or vehicle than its key says, or of another protocol version.
    """
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(content, dict):
        raise ValueError("a description is no JSON object")
    old = content.keys() <= Description.model_fields.keys() - {"protocol"}
    version = 1 if old else content.get("protocol")
    if version != PROTOCOL_VERSION:
        written_by = "aeroloop 0.1, which" if version == 1 else "the aeroloop that"
        raise ValueError(f"it is of protocol version {version}; read it with {written_by} wrote it")
    description = Description.model_validate(content)
    if address is not None and (address.vehicle, address.role) != (description.vehicle, description.role):
        raise ValueError(f"a description of {address.vehicle}'s {address.role} is of another role")
    return description


def merged(described: Mapping[str, Description]) -> Settings:
    """The configuration of a vehicle: each section from the role that owns it, as far as the log has the role.

    Args:
        described: Descriptions by role, of its controller or its plant at least.

    Raises:
        KeyError: There is neither.
        ConfigError: One is not of this version.
    """
    settings = from_description(described["controller" if "controller" in described else "plant"].config)
    owned: dict[str, Any] = {}
    for role, sections in OWNED.items():
        if role in described:
            its = from_description(described[role].config)
            owned |= {section: getattr(its, section) for section in sections}
    return settings.model_copy(update=owned)  # not validated again: each role ran by its own
