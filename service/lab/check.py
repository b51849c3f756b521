"""Check of a change by logs: each is computed again with the code and settings at hand, then its closed loop runs anew.

What the controller commands on the recorded measurements must be the same, byte for byte, unless the difference was
accepted: then a file beside the log has it. The closed loop runs in lockstep from the session's first tick, with
everything that came from outside as recorded, and its figures stand beside those of the log.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent import futures
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from aeroloop.protocol import plugins
from aeroloop.protocol.errors import AeroloopError, ConfigError
from aeroloop.protocol.plugins import PluginError
from aeroloop.service.config import as_overrides
from aeroloop.service.figures import Figures
from aeroloop.service.lab.engine import local_processes
from aeroloop.service.lab.fork import fork
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.logs.replay import AnotherWireError, replay
from aeroloop.service.recording.rolling import parts

ACCEPTED = ".accepted.json"
"""Ending of the file beside a log that has its accepted differences."""


class LogCheck(BaseModel, frozen=True):
    """A log, checked."""

    log: str
    commands: int = Field(default=0, description="commands that were computed again")
    differ: int = Field(default=0, description="how many of them differ")
    plant_ticks: int = Field(default=0, description="ticks of the plant that were computed again")
    plant_differ: int = 0
    first: list[str] = Field(default=[], description="where each end first differs: tick, signal, both values, steps")
    digests: list[str] = Field(default=[], description="of the computed commands of each session")
    accepted: bool = Field(default=False, description="whether these differences were accepted before")
    notes: list[str] = Field(default=[], description="what could not be compared or run, and why")
    error: str | None = Field(default=None, description="why it, or an end of it, could not be checked at all")
    unseen: list[str] = Field(
        default=[], description="what was not compared: rows that the log lacks, or that cannot be computed from it"
    )
    before: Figures | None = Field(default=None, description="of the longest session, as recorded")
    after: Figures | None = Field(default=None, description="of its closed loop, run again")

    @property
    def same(self) -> bool:
        """Whether everything was compared and nothing differs that was not accepted."""
        return self.error is None and not self.unseen and (self.accepted or not self.first)


def logs_of(paths: Sequence[Path]) -> list[list[Path]]:
    """The logs of a corpus, each with the files of its run: files, and all in folders. Raises ReviewError if none."""
    found = list[list[Path]]()
    for path in paths:
        if not path.is_dir():
            found.append([path])
            continue
        logs = sorted(log for log in path.glob("*.mcap") if not log.stem.endswith("-copy"))
        rotated = {part for log in logs for part in parts(log)[1:]}
        found += [parts(log) for log in logs if log not in rotated]
    if not found:
        raise ReviewError(f"there is no .mcap file in {', '.join(map(str, paths))}")
    return found


def check_logs(
    paths: Sequence[Path],
    overrides: Sequence[str] | Mapping[str, Any] = (),
    *,
    accept: bool = False,
    trust_law: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> list[LogCheck]:
    """Check the logs of a corpus with `section.key=value` replaced, on all cores; if `accept`, accept what differs.

    A law of one's own, or a plant, is imported if the caller has named it, or if `trust_law`: importing runs its code.

    Raises ReviewError if there is no log, ConfigError if an override is wrong, OutputError if the file beside a log
    cannot be written; a log that cannot be read is a result with an error.
    """
    logs = logs_of(paths)
    overrides = as_overrides(overrides) if isinstance(overrides, Mapping) else overrides
    with local_processes() as workers:
        trusted = plugins.vouched_for()
        running = {
            workers.executor.submit(check_log, files, tuple(overrides), trusted, trust_law=trust_law): i
            for i, files in enumerate(logs)
        }
        results = dict[int, LogCheck]()
        for done in futures.as_completed(running):
            results[running[done]] = done.result()
            progress(len(results) / len(logs))
    checked = [results[i] for i in range(len(logs))]
    if accept:
        for one in checked:
            if one.first and not one.accepted and one.error is None:
                with writing(_beside(one.log), force=True) as part:
                    part.write_text(json.dumps(_outcome(one), indent=1) + "\n", encoding="utf-8")
        checked = [one if one.error else one.model_copy(update={"accepted": bool(one.first)}) for one in checked]
    return checked


def check_log(
    files: Sequence[Path], overrides: Sequence[str], trusted: Collection[str] = (), *, trust_law: bool = False
) -> LogCheck:
    """Check one log, in any process, with classes that are `trusted` by their names, or with all if `trust_law`."""
    plugins.vouch_for(*trusted)
    with plugins.trusting(trust_law):
        return _check_log(files, overrides)


def _check_log(files: Sequence[Path], overrides: Sequence[str]) -> LogCheck:
    name, found, notes = str(files[0]), dict[str, Any](), list[str]()
    try:
        done = replay(files, overrides)
    except AnotherWireError as error:
        found["first"] = [str(error)]
    except AeroloopError as error:
        names_class = any(override.startswith(("law.kind", "plant.kind")) for override in overrides)
        of_log = isinstance(error, PluginError) and not names_class
        if overrides and isinstance(error, ConfigError) and not of_log:
            raise
        return LogCheck(log=name, error=str(error))
    else:
        if done.controller is not None:
            found |= {"commands": done.controller.ticks, "differ": done.controller.differ}
        if done.plant is not None:
            found |= {"plant_ticks": done.plant.ticks, "plant_differ": done.plant.differ}
        found |= {"first": done.first_differences, "digests": [one.digest for one in done.sessions]}
        unseen = dict.fromkeys(line for lines in done.unseen.values() for line in lines)
        found |= {"unseen": list(unseen), "error": "; ".join(done.failed.values()) or None}
        notes += [f"{end}: {reason}" for end, reason in done.reasons.items() if not overrides]
        notes += [f"not read: {line}" for line in done.damages if line not in unseen]
        notes += [f"not judged: {line}" for line in done.others]
    try:
        again = fork(files, 0, overrides=overrides)
        found |= {"before": again.recorded and again.recorded.figures, "after": again.figures}
        notes += [f"the closed loop ended: {again.ended}"] if again.ended else []
    except AeroloopError as error:
        notes.append(f"the closed loop was not run: {error}")
    result = LogCheck(log=name, notes=list(dict.fromkeys(notes)), **found)
    try:
        accepted = json.loads(_beside(name).read_text(encoding="utf-8")) == _outcome(result)
    except (OSError, ValueError):
        accepted = False
    return result.model_copy(update={"accepted": accepted})


def _beside(log: str) -> Path:
    path = Path(log)
    return path.with_name(path.stem + ACCEPTED)


def _outcome(one: LogCheck) -> dict[str, Any]:
    """What is accepted: no figure, whose last digits are the machine's."""
    return one.model_dump(
        mode="json", include={"commands", "differ", "plant_ticks", "plant_differ", "first", "digests"}
    )
