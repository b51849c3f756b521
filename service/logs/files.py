"""Files of a run (one, a folder, or those of a rotated run) read as one: descriptions, metadata, messages in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from mcap.records import Channel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description
from aeroloop.protocol.messages.trace import ENDS
from aeroloop.service.logs.mcap_file import Damage, Logged, messages
from aeroloop.service.logs.prelude import Prelude, ReviewError, address_of
from aeroloop.service.logs.traces import identified

__all__ = ["LogFiles", "Progress", "ReviewError"]

Progress = Callable[[float], None]
"""Called repeatedly with the share done, 0…1."""

T = TypeVar("T")


class LogFiles:
    """The logs of a run.

    Args:
        paths: Files and folders; of a folder, every `.mcap` in it.

    Attributes:
        paths: The files, in the order of their first messages.
        descriptions: The last description of each vehicle and role; `first_descriptions` the first.
        damages: What could not be read, by file; of a file with an index, only once its messages have been read.
        malformed: Messages that are malformed, by topic; whatever publishes them, they cost nothing else.
        metadata: Other metadata, by name without prefix (`aeroloop.recorder` is `recorder`); the last of each.

    Raises:
        ReviewError: There is no log, it cannot be read, has another version of the protocol, or is of another run.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.descriptions: dict[tuple[str, str], Description] = {}
        self.first_descriptions: dict[tuple[str, str], Description] = {}
        self.damages: dict[Path, list[Damage]] = {}
        self.malformed: Counter[str] = Counter()
        self._unreadable: list[tuple[Path, topics.Address, str]] = []  # descriptions
        self.metadata: dict[str, dict[str, Any]] = {}
        preludes = {path: Prelude(path) for path in _files(paths)}
        self.paths = sorted(preludes, key=lambda path: preludes[path].begins_ns)
        for path in self.paths:
            self._add(path, preludes[path])
        self._sort_out_descriptions()
        self._size = sum(path.stat().st_size for path in self.paths)
        recordings = {path: preludes[path].recording or path for path in self.paths}
        if len(set(recordings.values())) > 1:
            self._check_that_all_are_of_one_run(recordings)

    @property
    def name(self) -> str:
        """Name of the run."""
        first = str(self.paths[0])
        return first if len(self.paths) == 1 else f"{first} and {len(self.paths) - 1} more"

    def routed(
        self, route: Callable[[topics.Address], T | None], progress: Progress | None = None
    ) -> Iterator[Logged[T]]:
        """Messages of the keys that `route` selects, in the order of recording.

        `route` is called once per key of a file; its result comes with each message of the key, None drops the key.
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
            if damages:  # reading again finds the same
                self.damages[path] = list(dict.fromkeys([*self.damages.get(path, ()), *damages]))

    @property
    def damaged(self) -> list[str]:
        """What of the files is cut or damaged, a line each."""
        return [f"{path}: {damage}" for path, found in self.damages.items() for damage in found]

    @property
    def unread(self) -> list[str]:
        """What could not be read, a line each: damages, then malformed messages."""
        return [*self.damaged, *malformed_lines(self.malformed)]

    def _add(self, path: Path, prelude: Prelude) -> None:
        """Add what a file holds beside its traces. Raises ReviewError if it has none but unreadable descriptions."""
        found = prelude.descriptions()
        if prelude.unreadable and not found:
            raise ReviewError(f"{path} is not a log of this version: {prelude.unreadable[0]}")
        self._unreadable += [(path, address, text) for address, text in prelude.malformed]
        for which, copies in found.items():
            self.descriptions[which] = copies[-1]
            self.first_descriptions.setdefault(which, copies[0])
        self.metadata |= prelude.metadata
        if prelude.damages:
            self.damages[path] = prelude.damages

    def _sort_out_descriptions(self) -> None:
        """Count unreadable descriptions as malformed messages; the only one of an end that is described is a damage.

        Why: without it, the other end's configuration stands for it.
        """
        for path, address, text in self._unreadable:
            which = address.vehicle, address.role or ""
            others = {role for vehicle, role in self.descriptions if vehicle == which[0]}
            if which[1] in ENDS and which not in self.descriptions and others & set(ENDS):
                self.damages.setdefault(path, []).append(Damage(0, f"the description of {'/'.join(which)}: {text}"))
            else:
                self.malformed["description"] += 1

    def _check_that_all_are_of_one_run(self, recordings: Mapping[Path, Hashable]) -> None:
        """Raise ReviewError unless files of different recordings have traces of the same processes or sessions.

        Why: a recorder that was restarted goes on in a file of its own, but unrelated runs must not be mixed.
        """
        runs: list[tuple[set[Hashable], list[Path]]] = []
        for path in self.paths:
            marks: set[Hashable] = set()
            for found in messages(path, lambda channel: address_of(channel.topic, "trace")):
                if known := identified(found.answer.vehicle, found.data):
                    source, header = known
                    marks |= {source, (source.vehicle, header.session)} if header.session else {source}
            if not marks:
                continue  # it has no trace to be mixed with others
            marks.add(recordings[path])
            related = [run for run in runs if run[0] & marks]
            runs = [run for run in runs if run not in related]
            runs.append((marks.union(*(run[0] for run in related)), [*chain(*(run[1] for run in related)), path]))
        if len(runs) > 1:
            names = [f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}" for _, files in runs]
            some = "; ".join(names[:8]) + ("; …" if len(names) > 8 else "")
            raise ReviewError(
                f"these are {len(runs)} unrelated runs ({some}): name one of them, or see them side by side with "
                "`aeroloop log compare`"
            )


def malformed_lines(malformed: Mapping[str, int]) -> list[str]:
    """Malformed messages by topic, a line each."""
    return [f"malformed: {count} of {topic}" for topic, count in sorted(malformed.items()) if count]


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
