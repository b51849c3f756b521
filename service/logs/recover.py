"""Recovery of a broken log: copies every whole record into a new log with an index.

With an index, as at the end of a file that was closed, a damaged chunk costs itself. Without one, as a killed recorder
leaves a file, it is read from the front up to where no record begins. Damage is reported.
"""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.files import Progress
from aeroloop.service.logs.mcap_copy import McapCopy
from aeroloop.service.logs.mcap_file import Damage, NotMcapError
from aeroloop.service.logs.outputs import writing


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
        with broken.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
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
    lost = [f"at byte {damage.offset}: {damage.what}" for damage in damages]
    return Recovery(out=str(out), messages=copy.messages, channels=len(copy.topics), lost=lost)
