"""A recording: the files of a run (one, a folder, or those of a rotated run) read as one.

The files are read once for descriptions and the headers of the traces, and again for what is wanted of them: the rows
of a session, or the JSON messages of some keys.

A description is in a file several times: as a message in a chunk, and as metadata at the file's beginning and end. Why:
a damaged copy must not cost the log. A metadata record without its checksum is used only where there is no other copy.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, Final, TypeVar

from mcap.records import Channel, Message, Metadata

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import ENDS, Batch, End
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.logs.mcap_file import (
    CHECKSUM,
    DESCRIPTION_METADATA,
    Damage,
    Logged,
    NotMcapError,
    messages,
    records,
)
from aeroloop.service.logs.session import (
    ANSWER_S,
    BatchKey,
    Session,
    SessionKey,
    Source,
    TableBuilder,
    TraceIndex,
    checked_batch,
    join,
    key_of,
    table_dtype,
)

Progress = Callable[[float], None]
"""Called repeatedly with the share done, 0…1."""

INDEXING: Final = 0.4
"""Share of the progress that the first look at the files takes."""

OWNED: Final = {"plant": ("plant", "can"), "recorder": ("recorder",)}
"""Sections of the configuration by the role that owns them; the others are the controller's."""

T = TypeVar("T")


class ReviewError(AeroloopError):
    """A log cannot be reviewed; one line with the reason."""


class Recording:
    """The logs of a run.

    Args:
        paths: Files and folders; of a folder, every `.mcap` in it.
        progress: Called repeatedly with the share done: the first look at the files takes `INDEXING` of it.

    Attributes:
        paths: The files, in the order of their first messages.
        descriptions: The last description of each vehicle and role; `first_descriptions` the first.
        metadata: Other metadata, by name without prefix (`aeroloop.recorder` is `recorder`); the last of each.
        extents: Recorded extent of each session, in the order of recording.
        missing: Rows that the log lacks.
        unknown: Ticks that `session` leaves out, as the log does not hold what was in force then.
        damages: What of each file is cut or damaged.
        malformed: Messages that are malformed, by topic; whatever publishes them, they cost nothing else.

    Raises:
        ReviewError: There is no log, it cannot be read, has another version of the protocol, or is of another run.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.descriptions: dict[tuple[str, str], Description] = {}
        self.first_descriptions: dict[tuple[str, str], Description] = {}
        self.metadata: dict[str, dict[str, Any]] = {}
        self.damages: defaultdict[Path, list[Damage]] = defaultdict(list)
        self.malformed: Counter[str] = Counter()
        self._progress = progress or (lambda _: None)
        self._said: defaultdict[tuple[str, str], list[tuple[int, Description]]] = defaultdict(list)
        self._begun_ns: dict[Source | tuple[SessionKey, End], int] = {}  # first publication of rows
        self._unreadable: list[tuple[Path, Address, str]] = []  # descriptions
        self._index = TraceIndex()
        begins_ns = {path: _begin_ns(path) for path in _files(paths)}
        self.paths = sorted(begins_ns, key=begins_ns.__getitem__)
        self._size = sum(path.stat().st_size for path in self.paths)
        marks = {path: self._read(path) for path in self.paths}
        self._check_that_all_are_of_one_run(marks)
        self._sort_out_descriptions()
        self._index.finish()
        self.malformed["trace"] = self._index.malformed
        self.extents, self.missing, self.unknown = self._index.extents, self._index.missing, self._index.unknown

    @property
    def name(self) -> str:
        """Name of the run."""
        first = str(self.paths[0])
        return first if len(self.paths) == 1 else f"{first} and {len(self.paths) - 1} more"

    @property
    def damaged(self) -> list[str]:
        """What of the files is cut or damaged, a line each."""
        return [f"{path}: {damage}" for path, found in self.damages.items() for damage in found]

    @property
    def unread(self) -> list[str]:
        """What could not be read, a line each: damages, then malformed messages."""
        return [*self.damaged, *malformed_lines(self.malformed)]

    def choose(self, session: str | None = None, vehicle: str | None = None) -> SessionKey:
        """A session. Raises ReviewError if there is none.

        Args:
            session: Its name, alone or as `vehicle/session`, or its number, from 1 in the order of recording; the one
                with the most ticks if None.
            vehicle: Its vehicle; any if None, and that of the longest session for a number.
        """
        known = list(self.extents) if vehicle is None else self.sessions_of(vehicle)
        if not self.extents:
            raise ReviewError(f"{self.name} holds no session: no trace of a controller or a plant was recorded")
        if not known:
            vehicles = ", ".join(dict.fromkeys(vehicle for vehicle, _ in self.extents))
            raise ReviewError(f"{self.name} holds no session of {vehicle}, only of {vehicles}")
        longest = max(known, key=lambda which: self.extents[which].ticks)
        if session is None:
            return longest
        for which in known:
            if session in (which[1], "/".join(which)):
                return which
        numbered = self.sessions_of(longest[0])
        if session.isdecimal() and 0 < int(session) <= len(numbered):
            return numbered[int(session) - 1]
        names = ", ".join(f"{i} {which[1]}" for i, which in enumerate(numbered[:20], 1))
        more = f" and {len(numbered) - 20} more" if len(numbered) > 20 else ""
        raise ReviewError(f"{self.name} holds no session {session!r}; of {longest[0]} it holds {names}{more}")

    def sessions_of(self, vehicle: str) -> list[SessionKey]:
        """Sessions of a vehicle, in the order of recording."""
        return [which for which in self.extents if which[0] == vehicle]

    def described(self, which: SessionKey) -> dict[str, Description]:
        """Descriptions of a session's vehicle when it began, by role; and of the recorder."""
        found = {role: last for (_, role), last in self.descriptions.items() if role == "recorder"}
        found |= {role: last for (vehicle, role), last in self.descriptions.items() if vehicle == which[0]}
        for end in ENDS:
            if (which, end) in self._begun_ns and (
                its := self._described_at(which[0], end, self._begun_ns[which, end])
            ):
                found[end] = its
        return found

    def settings(self, which: SessionKey) -> Settings:
        """The configuration of a session, each section from the role that owns it, as far as the log has the role.

        Why: every process is configured by itself: the controller's copy of `plant.mass` may differ from the plant's.

        Raises:
            ReviewError: The logs have no description of its controller or plant.
            ConfigError: One is not of this version.
        """
        found = {role: described.config for role, described in self.described(which).items()}
        if (config := found.get("controller", found.get("plant"))) is None:
            damaged = "".join(f"; not read, {line}" for line in self.unread[:1])
            raise ReviewError(
                f"{self.name} has no description of {which[0]}'s controller or plant: its frames cannot be read"
                f"{damaged}"
            )
        owners = {role: from_description(found[role]) for role in OWNED if role in found}
        owned = {section: getattr(its, section) for role, its in owners.items() for section in OWNED[role]}
        return from_description(config).model_copy(update=owned)  # not validated again: each role ran by its own

    def session(self, which: SessionKey, since_s: float = -inf, until_s: float = inf) -> Session:
        """A session's rows and their join, from and to a time on the law's clock [s]; no other rows are read.

        Raises:
            ReviewError: The logs have no description of it, or it takes more memory than there is.
            ConfigError: A description is not of this version.
        """
        settings, wanted = self.settings(which), dict[Source, list[BatchKey]]()
        first, last = since_s / settings.loop.period, until_s / settings.loop.period
        tables: dict[End, TableBuilder] = {}
        for end in ENDS:
            until = last + (settings.loop.ticks(ANSWER_S) if end == "plant" else 0)  # when the last answer acts
            source, keys, rows = self._index.chosen(which, end, first, until)
            check_memory(rows * table_dtype(end, settings.wire).itemsize, rows)
            tables[end] = TableBuilder(end, settings.wire, rows)
            if source is not None:
                wanted[source] = keys
        for source, batch in self.batches(wanted):
            tables[source.end].add(batch)
        self.malformed["trace"] += sum(table.malformed for table in tables.values())
        unknown = self._index.unknown_of(which)
        controller, plant = tables["controller"].table(), tables["plant"].table(unknown)
        k, at_controller, at_plant, acted = join(controller, plant, first, last)
        return Session(
            which=which,
            settings=settings,
            descriptions=self.described(which),
            extent=self.extents[which],
            controller=controller,
            plant=plant,
            changes=[change for change in self._index.changes[which] if change.tick <= last],
            states=tables["controller"].states,
            missing=[gap for gap in self.missing if (gap.vehicle, gap.session) == which],
            unknown=[one for one in self.unknown if (one.vehicle, one.session) == which],
            k=k,
            at_controller=at_controller,
            at_plant=at_plant,
            acted=acted,
        )

    def plants(self) -> dict[Source, tuple[Description | None, int]]:
        """Processes of plants, with the description of each as it began, and its recorded rows."""
        return {
            source: (self._described_at(source.vehicle, "plant", self._begun_ns[source]), rows)
            for source, rows in self._index.plants.items()
        }

    def batches(self, wanted: Mapping[Source, Sequence[BatchKey] | None]) -> Iterator[tuple[Source, Batch]]:
        """Batches of some processes, each in the order of its rows and none twice; all of them for None."""
        keys = {source: self._index.keys(source) if some is None else some for source, some in wanted.items()}
        known = {source: set(some) for source, some in keys.items()}
        following = dict.fromkeys(keys, 0)
        waiting: dict[tuple[Source, BatchKey], Batch] = {}
        for found in self.messages(lambda address: address.vehicle if address.topic.name == "trace" else None):
            if (batch := checked_batch(found.data)) is None:
                continue
            source = Source(found.answer, batch.header.end, batch.header.run)
            key = key_of(batch.header, found.data)
            if key not in known.get(source, ()):
                continue
            waiting.setdefault((source, key), batch)
            its = keys[source]
            while following[source] < len(its) and (source, its[following[source]]) in waiting:
                key = its[following[source]]
                known[source].discard(key)
                following[source] += 1
                yield source, waiting.pop((source, key))

    def messages(self, wanted: Callable[[Address], T | None]) -> Iterator[Logged[T]]:
        """Messages of the keys that `wanted` selects, in the order of recording.

        `wanted` is called once per key of a file; its result comes with each message of the key, None drops the key.
        """
        for path in self.paths:
            yield from messages(path, _by_address(wanted))

    # ── The first look at the files ──

    def _read(self, path: Path) -> set[object]:
        """Read a file's descriptions, metadata and the headers of its traces; returns what marks its run."""
        before = sum(other.stat().st_size for other in self.paths[: self.paths.index(path)])
        addresses: dict[int, Address] = {}
        descriptions: list[Message] = []
        metadata: list[Metadata] = []
        marks: set[object] = set()

        def chosen(channel: Channel) -> bool:
            address = topics.read_key(channel.topic)
            if address is not None and address.topic.name in ("trace", "description"):
                addresses[channel.id] = address
            return channel.id in addresses

        def report(read: int) -> None:
            self._progress(INDEXING * (before + read) / self._size)

        for record in records(path, self.damages[path], report, chosen):
            if isinstance(record, Metadata):
                metadata.append(record)
            elif isinstance(record, Message) and addresses[record.channel_id].topic.name == "description":
                descriptions.append(record)
            elif isinstance(record, Message):
                vehicle = addresses[record.channel_id].vehicle
                if found := self._index.add(vehicle, record.data):
                    source, session = found
                    began: list[Source | tuple[SessionKey, End]] = [source]
                    if session:
                        began.append(((vehicle, session), source.end))
                        marks.add((vehicle, session))
                    marks.add(source)
                    for one in began:
                        self._begun_ns[one] = min(record.publish_time, self._begun_ns.get(one, record.publish_time))
        recording = self._add_metadata(path, metadata)
        copies: list[tuple[bool, int, str | bytes, Address | None]] = [
            (CHECKSUM in one.metadata, 0, one.metadata.get("json", ""), topics.read_key(one.metadata.get("key", "")))
            for one in metadata
            if one.name == DESCRIPTION_METADATA
        ]
        descriptions.sort(key=lambda one: one.publish_time)  # a file is in the order of arrival
        copies += [(True, one.publish_time, one.data, addresses[one.channel_id]) for one in descriptions]
        self._add_descriptions(path, copies)
        return marks and {*marks, recording or path}

    def _add_metadata(self, path: Path, metadata: Sequence[Metadata]) -> str | None:
        """Add the metadata that are no descriptions; returns the identity of the recording, if it has one."""
        own: dict[str, dict[str, Any]] = {}
        for one in metadata:
            if one.name.startswith("aeroloop.") and one.name != DESCRIPTION_METADATA:
                try:
                    content = json.loads(one.metadata.get("json", "{}"))
                except (ValueError, RecursionError) as error:
                    self.damages[path].append(Damage(0, f"metadata {one.name}: {str(error).splitlines()[0]}"))
                else:
                    own[one.name.removeprefix("aeroloop.")] = content if isinstance(content, dict) else {}
        self.metadata |= own
        identity = own.get("recorder", {}).get("id")
        return identity if isinstance(identity, str) else None

    def _add_descriptions(self, path: Path, copies: Sequence[tuple[bool, int, str | bytes, Address | None]]) -> None:
        """Add a file's copies of descriptions: whether each has a checksum, its time if a message, text and key.

        Raises ReviewError if none is readable.
        """
        found: dict[bool, list[tuple[int, Description]]] = {False: [], True: []}
        unreadable = []
        for checked, at_ns, text, address in copies:
            try:
                found[checked].append((at_ns, read_description(text, address)))
            except ValueError as error:
                unreadable.append(str(error).splitlines()[0])
                if address is not None and checked:
                    self._unreadable.append((path, address, unreadable[-1]))
                else:
                    self.damages[path].append(Damage(0, f"a description: {unreadable[-1]}"))
        known = {(one.vehicle, one.role) for _, one in found[True]}
        sound = [*found[True], *((0, one) for _, one in found[False] if (one.vehicle, one.role) not in known)]
        if unreadable and not sound:
            raise ReviewError(f"{path} is not a log of this version: {unreadable[0]}")
        for at_ns, one in sound:
            self.descriptions[one.vehicle, one.role] = one
            self.first_descriptions.setdefault((one.vehicle, one.role), one)
            if at_ns:
                self._said[one.vehicle, one.role].append((at_ns, one))

    def _described_at(self, vehicle: str, role: str, at_ns: int) -> Description | None:
        """The last description that a role published before a time [ns since 1970]; else its first."""
        before = [(said_ns, one) for said_ns, one in self._said[vehicle, role] if said_ns <= at_ns]
        return max(before, key=lambda one: one[0])[1] if before else self.first_descriptions.get((vehicle, role))

    def _sort_out_descriptions(self) -> None:
        """Count unreadable descriptions as malformed messages; the only one of an end that is described is a damage.

        Why: without it, the other end's configuration stands for it.
        """
        for path, address, text in self._unreadable:
            which = address.vehicle, address.role or ""
            others = {role for vehicle, role in self.descriptions if vehicle == which[0]}
            if which[1] in ENDS and which not in self.descriptions and others & set(ENDS):
                self.damages[path].append(Damage(0, f"the description of {'/'.join(which)}: {text}"))
            else:
                self.malformed["description"] += 1

    def _check_that_all_are_of_one_run(self, marks: Mapping[Path, set[object]]) -> None:
        """Raise ReviewError unless files of different recordings have traces of the same processes or sessions.

        Why: a recorder that was restarted goes on in a file of its own, but unrelated runs must not be mixed.
        """
        runs: list[tuple[set[object], list[Path]]] = []
        for path, its in marks.items():
            if its:  # else it has no trace to be mixed with others
                related = [run for run in runs if run[0] & its]
                runs = [run for run in runs if run not in related]
                runs.append((its.union(*(run[0] for run in related)), [*chain(*(run[1] for run in related)), path]))
        if len(runs) > 1:
            names = [f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}" for _, files in runs]
            some = "; ".join(names[:8]) + ("; …" if len(names) > 8 else "")
            raise ReviewError(
                f"these are {len(runs)} unrelated runs ({some}): name one of them, or see them side by side with "
                "`aeroloop log compare`"
            )


def read_description(text: str | bytes, address: Address | None) -> Description:
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


def malformed_lines(malformed: Mapping[str, int]) -> list[str]:
    """Malformed messages by topic, a line each."""
    return [f"malformed: {count} of {topic}" for topic, count in sorted(malformed.items()) if count]


def check_memory(needed: int, ticks: int) -> None:
    """Raise ReviewError if so many bytes are not available, for so many ticks."""
    available = available_bytes()
    if needed > available:
        raise ReviewError(
            f"{ticks} ticks take {needed / 2**30:.1f} GiB of memory, and {available / 2**30:.1f} GiB are available: "
            "`aeroloop log review` reads a part with --from and --to, `aeroloop log export` with --from and --until"
        )


def available_bytes() -> float:
    """Memory that can still be had; infinite where the system does not say [bytes]."""
    with suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return float(line.split()[1]) * 1024
    return inf


def _by_address(wanted: Callable[[Address], T | None]) -> Callable[[Channel], T | None]:
    def of(channel: Channel) -> T | None:
        address = topics.read_key(channel.topic)
        return None if address is None else wanted(address)

    return of


def _begin_ns(path: Path) -> int:
    """When a file's first message was recorded [ns since 1970]; 0 without any. Raises ReviewError."""
    try:
        return next((one.log_time for one in messages(path, lambda _: True)), 0)
    except NotMcapError as error:
        raise ReviewError(f"{error}, so it is no log") from None
    except OSError as error:
        raise ReviewError(f"cannot read {path}: {error.strerror}") from None


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
