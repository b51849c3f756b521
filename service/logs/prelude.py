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

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.topics import Address
from aeroloop.service.logs.mcap_file import (
    CHANGE_METADATA,
    CHECKSUM,
    DESCRIPTION_METADATA,
    Damage,
    NotMcapError,
    records,
    skim,
)
from aeroloop.service.logs.traces import SessionKey


class ReviewError(AeroloopError):
    """A log cannot be reviewed; one line with the reason."""


class Prelude:
    """What one file holds beside its traces, when its first message was recorded, and unreadable descriptions.

    Raises:
        ReviewError: It is no log, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.begins_ns = 0
        self.changes: dict[SessionKey, list[Change]] = {}
        self.metadata: dict[str, dict[str, Any]] = {}
        self.damages: list[Damage] = []
        self.unreadable: list[str] = []
        self._checked: dict[tuple[str, str], list[Description]] = {}  # copies under a checksum: of a chunk or their own
        self._unchecked: dict[tuple[str, str], list[Description]] = {}
        descriptions: dict[int, Address] = {}
        try:
            for record in skim(path, _is_description) or records(path, self.damages):
                if isinstance(record, Message):
                    self.begins_ns = self.begins_ns or record.log_time
                    if address := descriptions.get(record.channel_id):
                        self._add_description(record.data, address, self._checked)
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
        elif record.name == CHANGE_METADATA:
            change = Change.model_validate_json(text)
            self.changes.setdefault((address.vehicle if address else "", change.session), []).append(change)
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
        else:
            copies.setdefault((description.vehicle, description.role), []).append(description)


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


def address_of(key: str, topic: str) -> Address | None:
    """Address of a key if it is of this topic."""
    address = topics.read_key(key)
    return address if address is not None and address.topic.name == topic else None


def _is_description(key: str) -> bool:
    return address_of(key, "description") is not None
