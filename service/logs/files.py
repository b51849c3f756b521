"""Files of a run (one, a folder, or those of a rotated run) read as one: descriptions, metadata, messages in order."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mcap.records import Channel, Message, Metadata

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.operator import Change
from aeroloop.service.config import Settings, from_description
from aeroloop.service.logs.mcap_file import (
    CHANGE_METADATA,
    DESCRIPTION_METADATA,
    Damage,
    Logged,
    NotMcapError,
    messages,
    records,
    skim,
)
from aeroloop.service.logs.traces import SessionKey

Progress = Callable[[float], None]

T = TypeVar("T")


class ReviewError(AeroloopError):
    """A log cannot be reviewed; one line with the reason."""


class LogFiles:
    """The logs of a run.

    Args:
        paths: Files and folders; of a folder, every `.mcap` in it.

    Attributes:
        paths: The files, in the order of their first messages.
        descriptions: Descriptions by vehicle and role; the last of each.
        first_descriptions: The first of each.
        changes: Changes in force when a file began, by vehicle and session.
        damages: What could not be read, by file; of a file with an index, only once its messages have been read.
        metadata: Other metadata, by name without prefix (`aeroloop.recorder` is `recorder`); the last of each.

    Raises:
        ReviewError: There is no log, it cannot be read, or it has another version of the protocol.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.descriptions: dict[tuple[str, str], Description] = {}
        self.first_descriptions: dict[tuple[str, str], Description] = {}
        self.changes: dict[SessionKey, list[Change]] = {}
        self.damages: dict[Path, list[Damage]] = {}
        self.metadata: dict[str, dict[str, Any]] = {}
        starts = {path: self._prelude(path) for path in _files(paths)}
        self.paths = sorted(starts, key=lambda path: starts[path])
        if not self.descriptions:  # a damaged one may have a copy; if none can be read, the version differs
            for path, damages in self.damages.items():
                for damage in damages:
                    if DESCRIPTION_METADATA in damage.what:
                        raise ReviewError(f"{path} is not a log of this version: {damage.what}")
        self._size = sum(path.stat().st_size for path in self.paths)

    def settings(self, vehicle: str) -> Settings:
        """The configuration of a vehicle's controller if the logs have it, else its plant's.

        Raises:
            ReviewError: They have neither.
            ConfigError: It is not of this version.
        """
        for role in ("controller", "plant"):
            if description := self.descriptions.get((vehicle, role)):
                return from_description(description.config)
        raise ReviewError(
            f"{self.name} has no description of {vehicle}'s controller or plant: its frames cannot be read"
        )

    def plant(self, vehicle: str) -> PlantSettings:
        """The plant's own configuration if the logs have it, else what the controller assumed. Raises as `settings`."""
        description = self.descriptions.get((vehicle, "plant"))
        return self.settings(vehicle).plant if description is None else from_description(description.config).plant

    @property
    def name(self) -> str:
        """Name of the run."""
        first = str(self.paths[0])
        return first if len(self.paths) == 1 else f"{first} and {len(self.paths) - 1} more"

    def routed(
        self, route: Callable[[topics.Address], T | None], progress: Progress | None = None
    ) -> Iterator[Logged[T]]:
        """Messages of the keys that `route` selects, in the order of recording.

        Args:
            route: Called once per key of a file; its result comes with each message of the key, None drops the key.
            progress: Called repeatedly with the share done, 0…1.
        """

        def wanted(channel: Channel) -> T | None:
            address = topics.read_key(channel.topic)
            return None if address is None else route(address)

        read = 0
        report = None if progress is None else lambda reached: progress((read + reached) / self._size)
        for path in self.paths:
            damages: list[Damage] = []
            yield from messages(path, wanted, damages, report)
            read += path.stat().st_size
            if damages:
                self.damages[path] = damages

    @property
    def unread(self) -> list[str]:
        """What could not be read, a line each."""
        return [f"{path}: {damage.what}" for path, found in self.damages.items() for damage in found]

    def _prelude(self, path: Path) -> int:
        """Collect descriptions and other metadata; returns when the first message was recorded [ns]."""
        first = 0
        descriptions: set[int] = set()
        damages: list[Damage] = []
        try:
            for record in skim(path, _is_description) or records(path, damages):
                if isinstance(record, Message):
                    first = first or record.log_time
                    if record.channel_id in descriptions:
                        self._add_description(record.data, path)
                elif isinstance(record, Channel) and _is_description(record.topic):
                    descriptions.add(record.id)
                elif isinstance(record, Metadata):
                    try:
                        self._add_metadata(record, path)
                    except (ValueError, KeyError) as error:
                        damages.append(Damage(0, f"metadata {record.name}: {str(error).splitlines()[0]}"))
        except NotMcapError as error:
            raise ReviewError(f"{error}, so it is no log") from None
        except OSError as error:
            raise ReviewError(f"cannot read {path}: {error.strerror}") from None
        except (ValueError, KeyError) as error:
            raise ReviewError(f"{path} is not a log of this version: {str(error).splitlines()[0]}") from None
        if damages:
            self.damages[path] = damages
        return first

    def _add_metadata(self, record: Metadata, path: Path) -> None:
        text = record.metadata.get("json", "{}")
        if record.name == DESCRIPTION_METADATA:
            self._add_description(text.encode(), path)
        elif record.name == CHANGE_METADATA:
            change, address = Change.model_validate_json(text), topics.read_key(record.metadata["key"])
            known = self.changes.setdefault((address.vehicle if address else "", change.session), [])
            if change not in known:  # every file of a rotated run repeats it
                known.append(change)
        elif record.name.startswith("aeroloop."):
            content = json.loads(text)
            self.metadata[record.name.removeprefix("aeroloop.")] = content if isinstance(content, dict) else {}

    def _add_description(self, text: bytes, path: Path) -> None:
        content = json.loads(text)
        old = isinstance(content, dict) and content.keys() <= Description.model_fields.keys() - {"protocol"}
        if old or content["protocol"] != PROTOCOL_VERSION:
            version = 1 if old else content["protocol"]
            written_by = "aeroloop 0.1, which" if version == 1 else "the aeroloop that"
            raise ReviewError(f"{path} is a log of protocol version {version}; read it with {written_by} wrote it")
        description = Description.model_validate(content)
        self.descriptions[description.vehicle, description.role] = description
        self.first_descriptions.setdefault((description.vehicle, description.role), description)


def _is_description(key: str) -> bool:
    address = topics.read_key(key)
    return address is not None and address.topic.name == "description"


def _files(paths: Sequence[Path]) -> list[Path]:
    """Files, and those in folders without what `log export --to mcap` wrote there."""
    files: list[Path] = []
    for path in paths:
        found = [path]
        if path.is_dir():
            found = sorted(log for log in path.glob("*.mcap") if not log.stem.endswith("-decoded"))
        if not found:
            raise ReviewError(f"there is no .mcap file in {path}")
        files += found
    return files
