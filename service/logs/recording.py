"""A recording: the files of a run (one, a folder, or those of a rotated run) read as one.

The files are read once: descriptions, the traces' batches (140 MB an hour at 500 Hz) and what readers want of the JSON
messages stay in memory, until `release`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import ceil, inf
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.records import Channel, Message, Metadata
from pydantic_core import from_json

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import ENDS, Batch, read_batch
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA, RECORDER_METADATA, NotMcapError, records
from aeroloop.service.logs.session import (
    Entry,
    Missing,
    Session,
    SessionKey,
    Source,
    TraceIndex,
    Truths,
    Unknown,
    join,
    table_of,
    true_states,
)

Progress = Callable[[float], None]  # called repeatedly with the share done, 0…1

INDEXING: Final = 0.4  # share of the progress that reading the files takes
ANSWER_S: Final = 1.2  # longest time from a measurement until its command acts; a session's first may take a second
MESSAGES: Final = ("event", "loss", "status", "truth")  # whose messages are read beside the traces
OWNED: Final = {"plant": ("plant", "can"), "recorder": ("recorder",)}
"""Sections of the configuration by the role that owns them; the others are the controller's. Why: every process is
configured by itself: the controller's copy of `plant.mass` may differ from the plant's."""

_Copy = tuple[Path, int, str | bytes, Address | None]
"""A copy of a description: file, time of publication [ns since 1970] (0 in the metadata), text and key."""


class Judged(NamedTuple):
    """What a verdict on a session's vehicle is about, and what not.

    Attributes:
        sessions: In the order of recording: the session itself, those of which both ends have rows, and all others of
            the processes that have these.
        processes: That have one of the sessions.
        missing: Rows of the sessions that the log lacks.
        unknown: Ticks of the sessions of which the log does not hold what was in force.
        damages: What of the files is cut or damaged, a line each. That a file ends without its index, as a recorder
            leaves it that was killed, is a damage only if rows are missing, or if it is the last and no session's end.
        others: Sessions of the log that are not judged, a line each.
    """

    sessions: list[SessionKey]
    processes: set[Source]
    missing: list[Missing]
    unknown: list[Unknown]
    damages: list[str]
    others: list[str]


class ReviewError(AeroloopError):
    """A log cannot be reviewed; one line with the reason."""


class Recording:
    """The logs of a run, from files and folders; of a folder, every `.mcap` in it.

    Raises:
        ReviewError: There is no log, it cannot be read, has another version of the protocol, or is of another run.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.metadata: dict[str, dict[str, Any]] = {}  # but descriptions, by name without its prefix `aeroloop.`
        self.messages: list[tuple[Address, Message]] = []  # of the topics MESSAGES, in the order of recording
        self._damaged: list[str] = []  # what of the files is damaged, a line each
        self._unfinished: dict[Path, str] = {}  # files that end without their index
        self._undescribed: defaultdict[str, list[str]] = defaultdict(list)  # unreadable descriptions, by vehicle
        self.malformed: Counter[str] = Counter()  # messages by topic; they cost nothing else
        self._descriptions: defaultdict[tuple[str, str], list[tuple[int, Description]]] = defaultdict(list)
        self._index = TraceIndex()
        begins_ns, marks, copies = dict[Path, int](), dict[Path, set[object]](), list[_Copy]()
        self._ends_ns: dict[object, int] = {}  # when each recording wrote its last message [ns since 1970]
        try:
            sizes, done = {path: path.stat().st_size for path in _files(paths)}, 0
            for path, size in sizes.items():

                def report(read: int, before: int = done) -> None:
                    if progress is not None:
                        progress(INDEXING * (before + read) / max(1, sum(sizes.values())))

                begins_ns[path], marks[path] = self._read(path, report, copies)
                done += size
        except NotMcapError as error:
            raise ReviewError(f"{error}, so it is no log") from None
        except OSError as error:
            raise ReviewError(f"cannot read {error.filename or paths[0]}: {error.strerror}") from None
        self.paths = sorted(begins_ns, key=begins_ns.__getitem__)  # in the order of their first messages
        _check_that_all_are_of_one_run(marks)
        self._add_descriptions(copies)
        self._index.finish(self._ends_ns)
        self.malformed["trace"] = self._index.malformed
        self.extents, self.missing, self.unknown = self._index.extents, self._index.missing, self._index.unknown

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.paths[0]) + (f" and {len(self.paths) - 1} more" if len(self.paths) > 1 else "")

    @property
    def unread(self) -> list[str]:
        """What could not be read, a line each: damages, then malformed messages."""
        undescribed = [line for lines in self._undescribed.values() for line in lines]
        malformed = (f"malformed: {n} of {topic}" for topic, n in sorted(self.malformed.items()) if n)
        return [*self._damaged, *self._unfinished.values(), *undescribed, *malformed]

    # ── sessions ──

    def choose(self, session: str | None = None, vehicle: str | None = None) -> SessionKey:
        """A session by its name or number, and its vehicle. Raises ReviewError if there is none.

        Numbers count from 1 in the order of recording, by default of the longest session's vehicle. Without session it
        is the longest.
        """
        if not self.extents:
            raise ReviewError(f"{self.name} holds no session: no trace of a controller or a plant was recorded")
        known = [which for which in self.extents if vehicle in (None, which[0])]
        if not known:
            vehicles = ", ".join(dict.fromkeys(vehicle for vehicle, _ in self.extents))
            raise ReviewError(f"{self.name} holds no session of {vehicle}, only of {vehicles}")
        longest = max(known, key=lambda which: sum(self.extents[which].rows.values()))
        if session is None:
            return longest
        numbered = self.sessions_of(longest[0])
        named = {name: which for which in reversed(known) for name in (which[1], "/".join(which))}
        named = {str(i): which for i, which in enumerate(numbered, 1)} | named
        if session in named:
            return named[session]
        names = ", ".join(f"{i} {which[1]}" for i, which in enumerate(numbered[:20], 1))
        more = f" and {len(numbered) - 20} more" if len(numbered) > 20 else ""
        raise ReviewError(f"{self.name} holds no session {session!r}; of {longest[0]} it holds {names}{more}")

    def judged(self, session: SessionKey) -> Judged:
        """What a verdict on a session's vehicle is about.

        Why not all of the log: anybody on the network may publish a batch, of a vehicle, a session or a process of
        their own, and the recorder records every vehicle.
        """
        vehicle, owners = session[0], self._index.owners
        corroborated = {key for key in self._index.corroborated if key[0] == vehicle} | {session}
        processes = {process for key in corroborated for process in owners[key].values()}
        sessions = [key for key in self.sessions_of(vehicle) if not processes.isdisjoint(owners[key].values())]
        names = {"", *(name for _, name in sessions)}
        missing = [gap for gap in self.missing if gap.vehicle == vehicle and gap.session in names]
        unknown = [gap for gap in self.unknown if (gap.vehicle, gap.session) in sessions]
        damages = [*self._damaged, *self._undescribed.get(vehicle, ())]
        for path, line in self._unfinished.items():
            is_last = path == self.paths[-1]
            if any(gap.rows or is_last for gap in missing):
                damages.append(line)
        others: list[str] = []
        for key, extent in self.extents.items():
            if key not in sessions:
                others.append(f"{'/'.join(key)}, {sum(extent.rows.values())} rows")
        return Judged(sessions, processes, missing, unknown, damages, others)

    def sessions_of(self, vehicle: str) -> list[SessionKey]:
        """Sessions of a vehicle, in the order of recording."""
        return [which for which in self.extents if which[0] == vehicle]

    def session(self, which: SessionKey, since_s: float = -inf, until_s: float = inf) -> Session:
        """A session's rows and their join, from and to a time on the law's clock [s]; no other rows are read.

        Raises:
            ReviewError: The logs have no description of it.
            ConfigError: A description is not of this version.
        """
        settings = self.settings(which)
        first, last = since_s / settings.loop.period, until_s / settings.loop.period
        acted = last + ceil(ANSWER_S / settings.loop.period)  # when the last answer acts
        unknown = [one for one in self.unknown if (one.vehicle, one.session) == which]
        parts = {end: [one for one in self._index.parts[which, end] if one.header.rows] for end in ENDS}
        computed = [
            one
            for one in parts["controller"]
            if one.first <= last and one.last >= first
            if not any(gap.first_tick <= one.last <= gap.last_tick for gap in unknown)
        ]
        begin = parts["controller"].index(computed[0]) if computed else 0
        while computed and not computed[0].has_state and begin:  # computed from the last state that the log has
            begin -= 1
            computed.insert(0, parts["controller"][begin])
        payloads = self._index.payloads
        acting = [one for one in parts["plant"] if one.first <= acted and one.last >= first]
        controller, states, left_out = table_of("controller", settings.wire, computed, payloads)
        plant, _, more_left_out = table_of("plant", settings.wire, acting, payloads)
        self.malformed["trace"] += left_out + more_left_out
        for gap in unknown:
            plant = plant[(plant["session_tick"] < gap.first_tick) | (plant["session_tick"] > gap.last_tick)]
        return Session(
            which,
            settings,
            self.described(which),
            self.extents[which],
            controller,
            plant,
            [change for change in self._index.changes[which] if change.tick <= last],
            states,
            [gap for gap in self.missing if (gap.vehicle, gap.session) == which],
            unknown,
            *join(controller, plant, first, last),
        )

    def true_states(self, which: SessionKey, actuators: int) -> Truths:
        """True states of a session of a plant with so many motors; malformed ones are counted."""
        named = ("truth", which[0])
        payloads = (found.data for address, found in self.messages if (address.topic.name, address.vehicle) == named)
        truths, self.malformed["truth"] = true_states(payloads, which[1], actuators)
        return truths

    def plants(self) -> Iterator[tuple[Source, Description | None, list[Batch]]]:
        """Processes of plants, each with its description as it began, and all its batches in the order of its rows."""
        for source, entries in self._index.entries.items():
            if source.end == "plant" and entries:
                payloads = (bytes(self._index.payloads[entry.place]) for entry in entries)
                batches = [batch for payload in payloads if (batch := read_batch(payload)) is not None]
                yield source, self._described_before(source.vehicle, "plant", entries), batches

    def release(self) -> None:
        """Free batches and messages, once all that is wanted of them is read: no other session can be read then."""
        self._index, self.messages = TraceIndex(), []

    # ── descriptions ──

    @property
    def descriptions(self) -> dict[tuple[str, str], Description]:
        """The last description of each vehicle and role."""
        return {which: found[-1][1] for which, found in self._descriptions.items()}

    def described(self, which: SessionKey) -> dict[str, Description]:
        """Descriptions of a session's vehicle when it began, by role; and of the recorder."""
        known = self.descriptions.items()
        found = {role: last for (_, role), last in known if role == "recorder"}
        found |= {role: last for (vehicle, role), last in known if vehicle == which[0]}
        for end in ENDS:
            if its := self._described_before(which[0], end, self._index.parts[which, end]):
                found[end] = its
        return found

    def settings(self, which: SessionKey) -> Settings:
        """The configuration of a session, each section from the role that owns it, as far as the log has the role.

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

    def _described_before(self, vehicle: str, role: str, entries: Sequence[Entry]) -> Description | None:
        """The last description that a role published before these batches; else its first."""
        found = self._descriptions.get((vehicle, role))
        if found is None or not entries:
            return None
        begun_ns = min(entry.published_ns for entry in entries)
        return next((one for at_ns, one in reversed(found) if 0 < at_ns <= begun_ns), found[0][1])

    def _add_descriptions(self, copies: Sequence[_Copy]) -> None:
        """Add all copies of descriptions in the order of publication. Raises ReviewError if none is readable.

        One that is not is a malformed message; in the metadata, which the recorder writes, or as the only one of an
        end that has a trace it is a damage. Why: without it, the other end's configuration stands for it.
        """
        traced = {(source.vehicle, source.end) for source in self._index.entries}
        unreadable = list[tuple[Path, int, Address | None, str]]()
        for path, at_ns, text, address in sorted(copies, key=lambda one: one[1]):
            try:
                found = _read_description(text, address)
                self._descriptions[found.vehicle, found.role].append((at_ns, found))
            except ValueError as error:
                unreadable.append((path, at_ns, address, str(error).splitlines()[0]))
        if unreadable and not self._descriptions:
            raise ReviewError(f"{unreadable[0][0]} is not a log of this version: {unreadable[0][3]}")
        for path, at_ns, address, why in unreadable:
            end = None if address is None else (address.vehicle, address.role)
            if at_ns and (end not in traced or end in self._descriptions):
                self.malformed["description"] += 1
            elif address is None:
                self._damaged.append(f"{path}: a description: {why}")
            else:
                self._undescribed[address.vehicle].append(f"{path}: a description: {why}")

    # ── files ──

    def _read(self, path: Path, progress: Callable[[int], None], copies: list[_Copy]) -> tuple[int, set[object]]:
        """Read a file's metadata, descriptions and traces.

        Returns:
            When its first message was recorded [ns since 1970], and what marks its run: nothing without a trace.
        """
        addresses: dict[int, Address | None] = {}
        begin_ns, marks, damages = 0, set[object](), list[str]()
        unfinished: list[str] = []
        identity: object = path
        for record in records(path, damages, progress, unfinished):
            match record:
                case Channel():
                    addresses[record.id] = topics.read_key(record.topic)
                case Metadata(name=name, metadata=entries) if name == DESCRIPTION_METADATA:
                    copies.append((path, 0, entries.get("json", ""), topics.read_key(entries.get("key", ""))))
                case Metadata(name=name, metadata=entries) if name.startswith("aeroloop."):
                    try:
                        content = from_json(entries.get("json", "{}"))
                    except ValueError as error:
                        damages.append(f"metadata {name}: {str(error).splitlines()[0]}")
                        content = None
                    if isinstance(content, dict):
                        self.metadata[name.removeprefix("aeroloop.")] = content
                        if name == RECORDER_METADATA and isinstance(content.get("id"), str):
                            identity = content["id"]
                case Message(publish_time=at_ns, data=data):
                    begin_ns = begin_ns or record.log_time
                    self._ends_ns[identity] = max(self._ends_ns.get(identity, 0), record.log_time)
                    if (address := addresses.get(record.channel_id)) is None:
                        continue
                    if address.topic.name == "description":
                        copies.append((path, at_ns, data, address))
                    elif address.topic.name == "trace":
                        marks |= self._index.add(address.vehicle, data, at_ns, identity, record.log_time)
                    elif address.topic.name in MESSAGES:
                        self.messages.append((address, record))
        self._damaged += [f"{path}: {damage}" for damage in damages]
        if unfinished:
            self._unfinished[path] = f"{path}: {unfinished[0]}"
        return begin_ns, marks and {*marks, identity}


def _check_that_all_are_of_one_run(marks: Mapping[Path, set[object]]) -> None:
    """Raise ReviewError unless files of different recordings have traces of the same processes or sessions.

    Why: a recorder that was restarted goes on in a file of its own, but unrelated runs must not be mixed.
    """
    left = {path: its for path, its in marks.items() if its}  # one without a trace cannot be mixed with others
    runs: list[Path] = []
    while left:
        runs.append(next(iter(left)))
        run = left.pop(runs[-1])
        while related := [path for path, its in left.items() if its & run]:
            run = run.union(*(left.pop(path) for path in related))
    if len(runs) > 1:
        some = "; ".join(map(str, runs[:8])) + ("; …" if len(runs) > 8 else "")
        raise ReviewError(
            f"these are {len(runs)} unrelated runs ({some}): name one of them, or see them side by side with "
            "`aeroloop log compare`"
        )


def _read_description(text: str | bytes, address: Address | None) -> Description:
    """Parse a description, recorded under a key. Raises ValueError if it is malformed, or not what its key says."""
    content = from_json(text)
    version = content.get("protocol", PROTOCOL_VERSION) if isinstance(content, dict) else PROTOCOL_VERSION
    if version != PROTOCOL_VERSION:
        raise ValueError(f"it is of protocol version {version}; read it with the aeroloop that wrote it")
    description = Description.model_validate(content, extra="ignore")
    if address is not None and (address.vehicle, address.role) != (description.vehicle, description.role):
        raise ValueError(f"a description of {address.vehicle}'s {address.role} is of another role")
    try:
        from_description(description.config)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return description


def _files(paths: Sequence[Path]) -> list[Path]:
    """Files, and those in folders."""
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not found:
            raise ReviewError(f"there is no .mcap file in {path}")
        files += found
    return files
