"""A run as its logs tell it: one file, a folder, or the files of a rotated run, read as one and in bounded memory."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from mcap.records import Channel, Message, Metadata
from pydantic import ValidationError

from plant_emulator.settings import PlantSettings
from protocol import topics
from protocol.errors import AeroloopError
from protocol.messages import Contract, Lapse
from protocol.topics import Address
from protocol.verbs import Change
from service.config import Settings, from_contract
from service.logs.mcap_file import (
    CHANGE_METADATA,
    CONTRACT_METADATA,
    Damage,
    NotMcapError,
    messages,
    records,
    skim,
)

METADATA_PREFIX: Final = "aeroloop."

_TOLD: Final = ("change", "lapse")

T = TypeVar("T")

Which = tuple[str, str]
"""A vehicle and a session."""


class ReviewError(AeroloopError):
    """A log cannot be judged; one line that says why."""


class LogFiles:
    """The logs of a run.

    Args:
        paths: Files and folders; of a folder, every `.mcap` in it.

    Attributes:
        paths: The files, in the order of their first messages.
        contracts: Who took part, by role; the last of each.
        changes: What controllers followed from which tick on, by vehicle and session.
        lapses: Where controllers that hear silence did not compute with the plant's levels, likewise.
        damages: What could not be read, by file; of a file with an index, only once its messages have been read.
        metadata: What else the files say of themselves, by name (`aeroloop.recorder` is `recorder`); the last of each.

    Raises:
        ReviewError: Nothing is there, or no log can be read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.contracts: dict[str, Contract] = {}
        self.changes: dict[Which, list[Change]] = {}
        self.lapses: dict[Which, list[Lapse]] = {}
        self.damages: dict[Path, list[Damage]] = {}
        self.metadata: dict[str, dict[str, Any]] = {}
        self._told: set[tuple[str, bytes]] = set()  # changes and lapses, as vehicle and JSON
        starts = {path: self._prelude(path) for path in _files(paths)}
        self.paths = sorted(starts, key=lambda path: starts[path])
        if not self.contracts:  # one that is damaged may have a copy; where none can be read, it is not damage
            for path, damages in self.damages.items():
                for damage in damages:
                    if CONTRACT_METADATA in damage.what:
                        raise ReviewError(f"{path} is not a log of this version: {damage.what}")
        for changes in self.changes.values():
            changes.sort(key=lambda change: change.tick)
        self._size = sum(path.stat().st_size for path in self.paths)

    @property
    def settings(self) -> Settings:
        """The controller's configuration if the logs have it, else the plant's.

        Raises:
            ReviewError: They have neither.
            ConfigError: It is not of this version.
        """
        for role in ("controller", "plant"):
            if role in self.contracts:
                return from_contract(self.contracts[role].config)
        raise ReviewError(f"{self.name} has no contract of a controller or a plant, so its frames cannot be read")

    @property
    def plant(self) -> PlantSettings:
        """The plant's own configuration if the logs have it, else what the controller took for it. Raises as above."""
        contract = self.contracts.get("plant")
        return self.settings.plant if contract is None else from_contract(contract.config).plant

    @property
    def promised(self) -> dict[str, Any] | None:
        """The certificate in the controller's contract, if there is one."""
        contract = self.contracts.get("controller")
        return None if contract is None else contract.certificate

    @property
    def name(self) -> str:
        """What to call the run."""
        first = str(self.paths[0])
        return first if len(self.paths) == 1 else f"{first} and {len(self.paths) - 1} more"

    def messages(
        self, names: Collection[str], progress: Callable[[float], None] | None = None
    ) -> Iterator[tuple[topics.Address, bytes, int]]:
        """Key, content and time of publication [ns] of every message of these topics, in the order of recording."""
        return self.routed(lambda address: address if address.topic.name in names else None, progress)

    def routed(
        self, route: Callable[[topics.Address], T | None], progress: Callable[[float], None] | None = None
    ) -> Iterator[tuple[T, bytes, int]]:
        """The same with, instead of the key, what `route` says of it; it is asked once for every key of a file.

        Args:
            route: Whose the messages of a key are, such as a method that takes them; None leaves them out.
            progress: Called now and then with the share that is done, 0…1.
        """

        def wanted(channel: Channel) -> T | None:
            address = topics.read_key(channel.topic)
            return None if address is None else route(address)

        read = 0
        for path in self.paths:
            damages: list[Damage] = []
            for message in messages(path, wanted, damages, _share_of(progress, read, self._size)):
                yield message.answer, message.data, message.publish_time
            read += path.stat().st_size
            if damages:
                self.damages[path] = damages

    def _prelude(self, path: Path) -> int:
        """Gather contracts, changes and lapses, which may stand anywhere in a file.

        Returns:
            The time of its first message.
        """
        first = 0
        told: dict[int, Address] = {}
        damages: list[Damage] = []
        try:
            for record in skim(path, _is_told) or records(path, damages):
                if isinstance(record, Message):
                    first = first or record.publish_time
                    if record.channel_id in told:
                        self._tells(told[record.channel_id], record.data)
                elif isinstance(record, Channel):
                    key = topics.read_key(record.topic)
                    if key is not None and key.topic.name in _TOLD:
                        told[record.id] = key
                elif isinstance(record, Metadata):
                    try:
                        self._metadata(record.name, record.metadata)
                    except (ValidationError, ValueError, KeyError) as error:
                        damages.append(Damage(0, f"metadata {record.name}: {str(error).splitlines()[0]}"))
        except NotMcapError as error:
            raise ReviewError(f"{error}, so it is no log") from None
        except OSError as error:
            raise ReviewError(f"cannot read {path}: {error.strerror}") from None
        except (ValidationError, ValueError, KeyError) as error:
            raise ReviewError(f"{path} is not a log of this version: {str(error).splitlines()[0]}") from None
        if damages:
            self.damages[path] = damages
        return first

    def _metadata(self, name: str, entries: dict[str, str]) -> None:
        if name == CONTRACT_METADATA:
            contract = Contract.model_validate_json(entries["json"])
            self.contracts[contract.role] = contract
        elif name == CHANGE_METADATA:
            if key := topics.read_key(entries["key"]):
                self._tells(key, entries["json"].encode())
        elif name.startswith(METADATA_PREFIX) and "json" in entries:
            said = json.loads(entries["json"])
            self.metadata[name.removeprefix(METADATA_PREFIX)] = said if isinstance(said, dict) else {}

    def _tells(self, key: Address, text: bytes) -> None:
        """Add a change or a lapse; the files of a rotated run tell the same change again."""
        if (key.vehicle, text) in self._told:
            return
        self._told.add((key.vehicle, text))
        if key.topic.name == "lapse":
            lapse = Lapse.model_validate_json(text)
            self.lapses.setdefault((key.vehicle, lapse.session), []).append(lapse)
        else:
            change = Change.model_validate_json(text)
            self.changes.setdefault((key.vehicle, change.session), []).append(change)


def _is_told(key: str) -> bool:
    address = topics.read_key(key)
    return address is not None and address.topic.name in _TOLD


def _share_of(progress: Callable[[float], None] | None, before: int, size: int) -> Callable[[int], None] | None:
    return None if progress is None else lambda reached: progress((before + reached) / size)


def _logs_in(folder: Path) -> list[Path]:
    """The logs in a folder, but for those that `log export --to mcap` has written beside them."""
    return sorted(path for path in folder.glob("*.mcap") if not path.stem.endswith("-decoded"))


def _files(paths: Sequence[Path]) -> list[Path]:
    files: list[Path] = []
    for path in paths:
        found = _logs_in(path) if path.is_dir() else [path]
        if not found:
            raise ReviewError(f"there is no .mcap file in {path}")
        files += found
    return files
