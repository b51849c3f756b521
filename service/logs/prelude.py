"""Prelude of a log file: what it holds beside traces and events, and when it begins.

A description is in a file several times: as a message in a chunk, and as metadata at the file's beginning and end. Why:
a damaged copy must not cost the log. Of copies under a checksum, as chunks and our metadata have it, one that holds is
used; a copy without is used only where there is no other.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Metadata

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.topics import Address
from aeroloop.service.config import ConfigError, from_description
from aeroloop.service.logs.mcap_file import (
    CHECKSUM,
    DESCRIPTION_METADATA,
    Damage,
    NotMcapError,
    records,
)
from aeroloop.service.logs.recording import ReviewError

__all__ = ["Prelude", "ReviewError", "address_of", "read_description"]


class Prelude:
    """What one file holds beside its traces, when its first message was recorded, and unreadable descriptions.

    `unreadable` has why each of them cannot be read, and `malformed` those that are so by their publisher: what stands
    under a checksum is no damage of the file.

    Raises:
        ReviewError: It is no log, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.begins_ns = 0
        self.metadata: dict[str, dict[str, Any]] = {}
        self.damages: list[Damage] = []
        self.unreadable: list[str] = []
        self.malformed: list[tuple[Address, str]] = []
        self._checked: dict[tuple[str, str], list[Description]] = {}  # copies under a checksum: of a chunk or their own
        self._unchecked: dict[tuple[str, str], list[Description]] = {}
        descriptions: dict[int, Address] = {}
        described: list[tuple[int, bytes, Address]] = []
        try:
            for record in records(path, self.damages):
                if isinstance(record, Message):
                    self.begins_ns = self.begins_ns or record.log_time
                    if address := descriptions.get(record.channel_id):
                        described.append((record.publish_time, record.data, address))
                elif isinstance(record, Channel) and (address := address_of(record.topic, "description")):
                    descriptions[record.id] = address
                elif isinstance(record, Metadata):
                    try:
                        self._add_metadata(record)
                    except (ValueError, KeyError, RecursionError) as error:
                        self.damages.append(Damage(0, f"metadata {record.name}: {str(error).splitlines()[0]}"))
        except NotMcapError as error:
            raise ReviewError(f"{error}, so it is no log") from None
        except OSError as error:
            raise ReviewError(f"cannot read {path}: {error.strerror}") from None
        for _, data, address in sorted(described, key=lambda each: each[0]):  # a file is in the order of arrival
            self._add_description(data, address, self._checked)

    @property
    def recording(self) -> str | None:
        """Identity of the recording that it is part of; None if it has none."""
        identity = self.metadata.get("recorder", {}).get("id")
        return identity if isinstance(identity, str) else None

    def descriptions(self) -> dict[tuple[str, str], list[Description]]:
        """Copies of each role's descriptions, in order; those without a checksum only where there is no other."""
        return self._unchecked | self._checked

    def _add_metadata(self, record: Metadata) -> None:
        text, address = record.metadata.get("json", "{}"), topics.read_key(record.metadata.get("key", ""))
        if record.name == DESCRIPTION_METADATA:
            copies = self._checked if CHECKSUM in record.metadata else self._unchecked
            self._add_description(text.encode(), address, copies)
        elif record.name.startswith("aeroloop."):
            content = json.loads(text)
            self.metadata[record.name.removeprefix("aeroloop.")] = content if isinstance(content, dict) else {}

    def _add_description(
        self, text: bytes, address: Address | None, copies: dict[tuple[str, str], list[Description]]
    ) -> None:
        try:
            description = read_description(text, address)
        except ValueError as error:
            self.unreadable.append(str(error).splitlines()[0])
            if address is not None and copies is self._checked:
                self.malformed.append((address, self.unreadable[-1]))
            elif (damage := Damage(0, f"a description: {self.unreadable[-1]}")) not in self.damages:
                self.damages.append(damage)
        else:
            copies.setdefault((description.vehicle, description.role), []).append(description)


def read_description(text: bytes, address: Address | None) -> Description:
    """Parse a description, recorded under a key.

    Raises:
        ValueError: It is malformed, of another role or vehicle than its key says, of another protocol version, or its
            configuration is.
    """
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(content, dict):
        raise ValueError("a description is no JSON object")
    if (version := content.get("protocol", PROTOCOL_VERSION)) != PROTOCOL_VERSION:
        raise ValueError(f"it is of protocol version {version}; read it with the aeroloop that wrote it")
    description = Description.model_validate(content)
    if address is not None and (address.vehicle, address.role) != (description.vehicle, description.role):
        raise ValueError(f"a description of {address.vehicle}'s {address.role} is of another role")
    try:
        from_description(description.config)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return description


def address_of(key: str, topic: str) -> Address | None:
    """Address of a key if it is of this topic."""
    address = topics.read_key(key)
    return address if address is not None and address.topic.name == topic else None
