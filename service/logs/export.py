"""Export: a log for programs that know nothing of frames, as a table or as a log with everything decoded.

For a table the log is read twice. First the review's own reader tells every tick of every session, so that what is
exported is what is judged; only then is it known which session is the longest. Then comes what stands beside the ticks.
Both are put aside on disk, and written out as a table from there, so that memory does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from protocol.host import versions
from protocol.messages import Telemetry, Truth
from service.config import ConfigError, Settings
from service.logs.files import LogFiles, ReviewError, Which
from service.logs.mcap_file import Damage
from service.logs.review import read
from service.logs.spool import Pile, Records, Spool, Window
from service.logs.table import Rows, groups, telemetry_fields, tick_fields, truth_fields
from service.logs.table_files import FILES, ExportError
from service.logs.ticks import Tick

Format = Literal["parquet", "csv", "mat", "mcap"]
Progress = Callable[[float], None]

ALL: Final = "all"

ENDINGS: Final[dict[Format, str]] = {
    "parquet": ".parquet",
    "csv": ".csv",
    "mat": ".mat",
    "mcap": "-decoded.mcap",
}
"""What the name of a new file ends in."""


class Exported(BaseModel):
    """What was exported."""

    model_config = ConfigDict(frozen=True)

    out: str
    format: str
    sessions: list[str] | None = Field(description="`vehicle/session`, in the order of the rows; null of a log")
    rows: int = Field(description="rows of a table, messages of a log")
    columns: list[str] = Field(description="names of a table's columns, topics of a log's channels")
    bytes: int
    damages: list[str] = Field(description="what of the log could not be read")


def export(
    paths: Sequence[Path],
    to: Format,
    out: Path | None = None,
    *,
    session: str | None = None,
    progress: Progress | None = None,
) -> Exported:
    """Write a run's ticks as a table, or all of it as a log with everything decoded.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        to: What kind of file.
        out: The file, which must not exist; the first log's name with another ending if None.
        session: Whose ticks: a name, alone or as `vehicle/session`; `all`; the longest session if None.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        ExportError: There is nothing to export, or it cannot be written.
        ReviewError: The log cannot be read.
    """
    out = out or beside(paths[0], ENDINGS[to])
    try:
        with writing(out) as part:
            exported = (
                _log(paths, part, session, progress) if to == "mcap" else _table(paths, to, part, session, progress)
            )
    except ConfigError as error:
        raise ExportError(f"{paths[0]} is not a log of this version: {error}") from None
    return exported.model_copy(update={"out": str(out)})


def _log(paths: Sequence[Path], part: Path, session: str | None, progress: Progress | None) -> Exported:
    from service.logs.decoded_log import write_decoded

    if session is not None:
        raise ExportError("--session chooses the rows of a table; --to mcap writes the log with all its sessions")
    written = write_decoded(LogFiles(paths), part, _share(progress, 0.0, 1.0))
    return Exported(
        out=str(part),
        format="mcap",
        sessions=None,
        rows=written.messages,
        columns=written.topics,
        bytes=part.stat().st_size,
        damages=_lines(written.damages),
    )


def _table(paths: Sequence[Path], to: Format, part: Path, session: str | None, progress: Progress | None) -> Exported:
    with Spool(part.parent) as spool:
        ticks = _Ticks(spool)
        longest = read(*paths, watch=ticks.watch, progress=_share(progress, 0.0, 0.7)).which
        files = LogFiles(paths)
        settings = files.settings
        chosen = _chosen(ticks.piles, longest, session, files.name)
        beside_them = _Beside(spool, settings, chosen)
        beside_them.gather(files, _share(progress, 0.7, 0.8))
        table = groups(settings.wire, settings.loop.period)
        sessions = ["/".join(which) for which in chosen]
        file = FILES[to](part, table, facts(files, settings, sessions))
        total, done, written = sum(ticks.piles[which].rows for which in chosen), 0, _share(progress, 0.8, 1.0)
        for which in chosen:
            for block in beside_them.rows(which, ticks.piles[which]):
                file.write(block)
                done += len(block.ticks)
                written(done / total)
        file.close()
    return Exported(
        out=str(part),
        format=to,
        sessions=sessions,
        rows=done,
        columns=[column.name for group in table for column in group.columns],
        bytes=part.stat().st_size,
        damages=_lines(files.damages),
    )


def _lines(damages: dict[Path, list[Damage]]) -> list[str]:
    return [f"{path}: {damage.what}" for path, found in damages.items() for damage in found]


def beside(log: Path, ending: str) -> Path:
    """A log's name, or its folder's, with another ending."""
    if log.is_dir():
        log = log.resolve()  # of "." there is no name
        return log.with_name(log.name + ending)
    return log.with_name(log.stem + ending)


@contextmanager
def writing(out: Path) -> Iterator[Path]:
    """What a new file is called until it is whole; half of one is removed.

    Raises:
        ExportError: It exists, or cannot be written.
    """
    if out.exists():
        raise ExportError(f"{out} exists already; name another file with --out")
    part = out.with_name(f"{out.name}.part")
    try:
        yield part
        part.rename(out)
    except OSError as error:
        raise ExportError(f"cannot write {out}: {error.strerror or error}") from None
    finally:
        part.unlink(missing_ok=True)


def facts(files: LogFiles, settings: Settings, sessions: Sequence[str]) -> dict[str, Any]:
    """What a file tells of itself as a whole."""
    return {
        "config": settings.contract(),
        "sessions": list(sessions),
        "logs": [str(path) for path in files.paths],
        "recorded_by": {role: contract.versions for role, contract in files.contracts.items()},
        "exported_by": versions(),
    }


class _Ticks:
    """Puts aside every tick of every session."""

    def __init__(self, spool: Spool) -> None:
        self._spool = spool
        self.piles: dict[Which, Pile] = {}

    def watch(self, which: Which, settings: Settings) -> Callable[[Tick], None]:
        """Who is told the ticks of a session."""
        pile = self.piles[which] = self._spool.pile(tick_fields(settings.wire.actuators))
        add = pile.add

        def keep(tick: Tick) -> None:
            add(
                tick.k,
                tick.published_ns,
                -1 if tick.latency_ns is None else tick.latency_ns,
                *tick.attitude,
                *tick.desired,
                *tick.rate,
                *tick.desired_rate,
                *tick.attitude_error,
                *tick.rate_error,
                *tick.voltages,
            )

        return keep


class _Beside:
    """Telemetry of some sessions and the truth of their vehicles, and which of it belongs to which tick."""

    def __init__(self, spool: Spool, settings: Settings, sessions: Sequence[Which]) -> None:
        actuators = settings.wire.actuators
        self._telemetry = {which: spool.pile(telemetry_fields(actuators)) for which in sessions}
        self._truth = {vehicle: spool.pile(truth_fields(actuators)) for vehicle, _ in sessions}

    def gather(self, files: LogFiles, progress: Progress) -> None:
        """Read it. Raises ReviewError."""
        try:
            for address, payload, published_ns in files.messages(("telemetry", "truth"), progress):
                if address.topic.name == "telemetry":
                    told = Telemetry.model_validate_json(payload)
                    pile = self._telemetry.get((address.vehicle, told.session))
                    if pile is not None:
                        pile.add(told.tick, *told.damping_estimate, *told.voltages, told.sign)
                elif (pile := self._truth.get(address.vehicle)) is not None:
                    truth = Truth.model_validate_json(payload)
                    pile.add(published_ns, *truth.attitude, *truth.rate, *truth.voltages)
        except ValidationError as error:
            raise ReviewError(f"{files.name} is not a log of this version: {str(error).splitlines()[0]}") from None

    def rows(self, which: Which, ticks: Pile) -> Iterator[Rows]:
        """A session's ticks with what stands beside them, a block at a time."""
        telemetry = Window(self._telemetry[which], "k")
        truth = Window(self._truth[which[0]], "published_ns")
        for block in ticks.blocks():
            told, is_told = telemetry.not_after(block["k"])
            true, is_true = truth.not_after(block["published_ns"])
            yield Rows(*which, block, _only(told, is_told & (told["k"] == block["k"])), _only(true, is_true))


def _only(rows: Records, found: npt.NDArray[np.bool_]) -> Records:
    """The rows, with NaN for every double of those that were not found."""
    rows = rows.copy()
    assert rows.dtype.names is not None
    for name in rows.dtype.names:
        if rows[name].dtype == np.float64:
            rows[name][~found] = np.nan
    return rows


def _chosen(piles: dict[Which, Pile], longest: Which, session: str | None, name: str) -> list[Which]:
    known = [which for which, pile in piles.items() if pile.rows]
    if session is None:
        chosen = [which for which in known if which == longest]
    elif session == ALL:
        chosen = known
    else:
        chosen = [which for which in known if session in (which[1], "/".join(which))]
        if known and not chosen:
            names = ", ".join("/".join(which) for which in known[:5]) + (", …" if len(known) > 5 else "")
            raise ExportError(f"{name} has no session {session!r} with a tick; it has {names}")
    if not chosen:
        raise ExportError(f"{name} has no answered measurement to export")
    return chosen


def _share(progress: Progress | None, begin: float, end: float) -> Progress:
    """Progress of a part of the work that begins and ends at these shares of the whole."""
    if progress is None:
        return lambda _share: None
    return lambda share: progress(begin + share * (end - begin))
