"""Recovery of a broken log: every whole record is copied into a new log with an index, and what was lost is named."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.mcap_copy import McapCopy
from aeroloop.service.logs.mcap_file import Damage, NotMcapError
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress


class RecoverError(AeroloopError):
    """Nothing can be recovered; one line with the reason."""


class Recovery(BaseModel, frozen=True):
    """What was recovered."""

    out: str
    messages: int
    channels: int
    lost: list[str] = Field(description="what could not be read, a line each; empty if the file was whole")


def recover(broken: Path, out: Path, progress: Progress | None = None, *, force: bool = False) -> Recovery:
    """Write all that can be read of a log into a new file; `force` replaces an existing one that is no log.

    Raises:
        OutputError: The new file must not be written, or cannot.
        RecoverError: It is not an MCAP file, or cannot be read.
    """
    damages: list[Damage] = []
    try:
        size = broken.stat().st_size
        with writing(out, [broken], force=force) as part, part.open("xb") as new:
            copy = McapCopy(new, "aeroloop log recover")
            copy.file(broken, damages, lambda read: progress(read / size) if progress else None)
            if not copy.messages:
                raise RecoverError(f"{broken} holds no whole message")
            copy.finish()
            new.flush()
    except NotMcapError as error:
        raise RecoverError(f"{error}, so there is nothing to recover") from None
    except OSError as error:
        raise RecoverError(f"cannot read {broken}: {error.strerror}") from None
    return Recovery(out=str(out), messages=copy.messages, channels=len(copy.topics), lost=list(map(str, damages)))
