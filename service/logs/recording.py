"""A recording: the files of a run (one, a folder, or those of a rotated run) read as one.

The files are read once for descriptions and the index of the traces, and again for what is wanted of them: the rows of
a session, or the JSON messages of some keys.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from aeroloop.protocol.messages.trace import ENDS, Batch, End, read_batch
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.logs.mcap_file import (
    DESCRIPTION_METADATA,
    RECORDER_METADATA,
    Damage,
    NotMcapError,
    messages,
    records,
)
from aeroloop.service.logs.session import ANSWER_S, Session, SessionKey, Source, TableBuilder, join, table_dtype
from aeroloop.service.logs.trace_index import Entry, TraceIndex, identity_of

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
        metadata: Metadata that are no descriptions, by name without prefix (`aeroloop.recorder` is `recorder`).
        extents: Recorded extent of each session, in the order of recording.
        missing: Rows that the log lacks.
        unknown: Ticks that `session` leaves out, as the log does not hold what was in force then.
        damages: What of each file is cut or damaged.
        malformed: Messages that are malformed, by topic; whatever publishes them, they cost nothing else.

    Raises:
        ReviewError: There is no log, it cannot be read, has another version of the protocol, or is of another run.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.metadata: dict[str, dict[str, Any]] = {}
        self.damages: defaultdict[Path, list[Damage]] = defaultdict(list)
        self.malformed: Counter[str] = Counter()
        self._descriptions: dict[tuple[str, str], list[tuple[int, Description]]] = {}  # by time of publication, or 0
        self._begun_ns: dict[Source | tuple[SessionKey, End], int] = {}  # first publication of rows
        self._index = TraceIndex()
        begins_ns = {path: _begin_ns(path) for path in _files(paths)}
        self.paths = sorted(begins_ns, key=begins_ns.__getitem__)
        size, done = max(1, sum(path.stat().st_size for path in self.paths)), 0
        copies: list[tuple[Path, int, str | bytes, Address | None]] = []
        marks = dict[Path, set[object]]()
        for path in self.paths:

            def report(read: int, before: int = done) -> None:
                if progress is not None:
                    progress(INDEXING * (before + read) / size)

            marks[path] = self._read(path, report, copies)
            done += path.stat().st_size
        _check_that_all_are_of_one_run(marks)
        self._add_descriptions(copies)
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

    @property
    def descriptions(self) -> dict[tuple[str, str], Description]:
        """The last description of each vehicle and role."""
        return {which: found[-1][1] for which, found in self._descriptions.items()}

    def described(self, which: SessionKey) -> dict[str, Description]:
        """Descriptions of a session's vehicle when it began, by role; and of the recorder."""
        found = {role: last for (_, role), last in self.descriptions.items() if role == "recorder"}
        found |= {role: last for (vehicle, role), last in self.descriptions.items() if vehicle == which[0]}
        for end in ENDS:
            if its := self._described_at(which[0], end, self._begun_ns.get((which, end))):
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
        settings = self.settings(which)
        first, last = since_s / settings.loop.period, until_s / settings.loop.period
        tables: dict[End, TableBuilder] = {}
        wanted: dict[End, list[Entry]] = {}
        for end in ENDS:
            until = last + (settings.loop.ticks(ANSWER_S) if end == "plant" else 0)  # when the last answer acts
            wanted[end] = self._index.part(which, end, first, until)
            rows = sum(entry.rows for entry in wanted[end])
            check_memory(rows * table_dtype(end, settings.wire).itemsize, rows)
            tables[end] = TableBuilder(end, settings.wire, rows)
        for end, batch in self._batches(wanted):
            tables[end].add(batch)
        self.malformed["trace"] += sum(table.malformed for table in tables.values())
        unknown = [one for one in self.unknown if (one.vehicle, one.session) == which]
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
            unknown=unknown,
            k=k,
            at_controller=at_controller,
            at_plant=at_plant,
            acted=acted,
        )

    def plants(self) -> dict[Source, tuple[Description | None, int]]:
        """Processes of plants, with the description of each as it began, and its recorded rows."""
        return {
            source: (
                self._described_at(source.vehicle, "plant", self._begun_ns[source]),
                sum(entry.rows for entry in entries),
            )
            for source, entries in self._index.entries.items()
            if source.end == "plant" and entries
        }

    def batches(self, sources: Iterable[Source]) -> Iterator[tuple[Source, Batch]]:
        """All batches of some processes, each in the order of its rows and none twice."""
        return self._batches({source: self._index.entries[source] for source in sources})

    def _batches(self, wanted: Mapping[T, Sequence[Entry]]) -> Iterator[tuple[T, Batch]]:
        """Some batches, by any key, in the order that they have there."""
        orders = {key: deque(entry.identity for entry in entries) for key, entries in wanted.items()}
        keys = {identity: key for key, order in orders.items() for identity in order}
        waiting: dict[int, Batch] = {}
        for vehicle, found in self.messages(lambda address: address.vehicle if address.topic.name == "trace" else None):
            identity = identity_of(vehicle, found.data)
            if (key := keys.pop(identity, None)) is None or (batch := read_batch(found.data)) is None:
                continue
            waiting[identity] = batch
            while orders[key] and orders[key][0] in waiting:
                yield key, waiting.pop(orders[key].popleft())

    def messages(self, wanted: Callable[[Address], T | None]) -> Iterator[tuple[T, Message]]:
        """Messages of the keys that `wanted` selects, in the order of recording, each with its result for the key.

        It is called once per key of a file; None drops the key.
        """

        def of(channel: Channel) -> T | None:
            address = topics.read_key(channel.topic)
            return None if address is None else wanted(address)

        for path in self.paths:
            yield from messages(path, of)

    # ── The first look at the files ──

    def _read(
        self,
        path: Path,
        progress: Callable[[int], None],
        copies: list[tuple[Path, int, str | bytes, Address | None]],
    ) -> set[object]:
        """Read a file's metadata and index its traces; returns what marks its run.

        Copies of descriptions are appended to `copies`: file, time of publication (0 of metadata), text and key.
        """
        addresses: dict[int, Address | None] = {}
        marks: set[object] = set()
        identity: object = path
        for record in records(path, self.damages[path], progress):
            match record:
                case Channel():
                    addresses[record.id] = topics.read_key(record.topic)
                case Metadata(name=name, metadata=entries) if name == DESCRIPTION_METADATA:
                    copies.append((path, 0, entries.get("json", ""), topics.read_key(entries.get("key", ""))))
                case Metadata(name=name) if name.startswith("aeroloop."):
                    content = self._add_metadata(path, record)
                    if name == RECORDER_METADATA and isinstance(content.get("id"), str):
                        identity = content["id"]
                case Message() if (address := addresses.get(record.channel_id)) is not None:
                    if address.topic.name == "description":
                        copies.append((path, record.publish_time, record.data, address))
                    elif address.topic.name == "trace" and (found := self._index.add(address.vehicle, record.data)):
                        source, session = found
                        which = address.vehicle, session
                        marks |= {source, which} if session else {source}
                        for one in (source, (which, source.end)):
                            self._begun_ns.setdefault(one, record.publish_time)
                            self._begun_ns[one] = min(self._begun_ns[one], record.publish_time)
        return marks and {*marks, identity}

    def _add_metadata(self, path: Path, record: Metadata) -> dict[str, Any]:
        try:
            content = json.loads(record.metadata.get("json", "{}"))
        except (ValueError, RecursionError) as error:
            self.damages[path].append(Damage(0, f"metadata {record.name}: {str(error).splitlines()[0]}"))
            content = {}
        content = content if isinstance(content, dict) else {}
        self.metadata[record.name.removeprefix("aeroloop.")] = content
        return content

    def _add_descriptions(self, copies: Sequence[tuple[Path, int, str | bytes, Address | None]]) -> None:
        """Add all copies of descriptions in the order of publication. Raises ReviewError if none is readable.

        One that is not is a malformed message; in the metadata, which the recorder writes, or as the only one of an
        end it is a damage. Why: without it, the other end's configuration stands for it.
        """
        unreadable: list[tuple[Path, int, Address | None, str]] = []
        for path, at_ns, text, address in sorted(copies, key=lambda one: one[1]):
            try:
                found = read_description(text, address)
            except ValueError as error:
                unreadable.append((path, at_ns, address, str(error).splitlines()[0]))
            else:
                self._descriptions.setdefault((found.vehicle, found.role), []).append((at_ns, found))
        if unreadable and not self._descriptions:
            raise ReviewError(f"{unreadable[0][0]} is not a log of this version: {unreadable[0][-1]}")
        for path, at_ns, address, why in unreadable:
            known = address is None or address.role not in ENDS or (address.vehicle, address.role) in self._descriptions
            if at_ns and known:
                self.malformed["description"] += 1
            else:
                self.damages[path].append(Damage(0, f"a description: {why}"))

    def _described_at(self, vehicle: str, role: str, at_ns: int | None) -> Description | None:
        """The last description that a role published before a time [ns since 1970]; else its first."""
        found = self._descriptions.get((vehicle, role))
        if found is None or at_ns is None:
            return None
        return next((one for said_ns, one in reversed(found) if 0 < said_ns <= at_ns), found[0][1])


def _check_that_all_are_of_one_run(marks: Mapping[Path, set[object]]) -> None:
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
    description = Description.model_validate(content, extra="ignore")
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
            "`aeroloop log review` and `aeroloop log export` read a part with --from and --to"
        )


def available_bytes() -> float:
    """Memory that can still be had; infinite where the system does not say [bytes]."""
    with suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return float(line.split()[1]) * 1024
    return inf


def _begin_ns(path: Path) -> int:
    """When a file's first message was recorded [ns since 1970]; 0 without any. Raises ReviewError."""
    try:
        return next((one.log_time for _, one in messages(path, lambda _: True)), 0)
    except NotMcapError as error:
        raise ReviewError(f"{error}, so it is no log") from None
    except OSError as error:
        raise ReviewError(f"cannot read {path}: {error.strerror}") from None


def _files(paths: Sequence[Path]) -> list[Path]:
    """Files, and those in folders without what `log export --format mcap` wrote there."""
    files: list[Path] = []
    for path in paths:
        found = [path]
        if path.is_dir():
            found = sorted(log for log in path.glob("*.mcap") if not log.stem.endswith("-decoded"))
        if not found:
            raise ReviewError(f"there is no .mcap file in {path}")
        files += found
    return files
