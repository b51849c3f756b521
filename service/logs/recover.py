"""Recovery of a broken log: copies every whole record into a new log with an index.

A log without its end, as a killed recorder leaves it, is read from the front. Damage is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.mcap_copy import McapCopy
from aeroloop.service.logs.mcap_file import Damage, NotMcapError


class RecoverError(AeroloopError):
    """Nothing can be recovered; one line with the reason."""


class Recovery(BaseModel, frozen=True):
    """What was recovered."""

    out: str
    messages: int
    channels: int
    lost: list[str] = Field(description="what could not be read, a line each; empty if the file was whole")


def recover(broken: Path, out: Path, progress: Callable[[float], None] | None = None) -> Recovery:
    """Write all that can be read of a log into a new file.

    Args:
        broken: The log; it is not changed.
        out: The new file, which must not exist; it is removed again on any error.
        progress: Called repeatedly with the share done, 0…1.

    Raises:
        RecoverError: It is not an MCAP file, or the new one cannot be written.
    """
    damages: list[Damage] = []
    try:
        size = broken.stat().st_size
        with out.open("xb") as file:
            try:
                copy = McapCopy(file, "aeroloop log recover")
                copy.file(broken, damages, lambda read: progress(read / size) if progress else None)
                if not copy.messages:
                    raise RecoverError(f"{broken} holds no whole message")
                copy.finish()
                file.flush()
            except BaseException:
                out.unlink()
                raise
    except NotMcapError as error:
        raise RecoverError(f"{error}, so there is nothing to recover") from None
    except FileExistsError:
        raise RecoverError(f"{out} exists already; name another file") from None
    except OSError as error:
        raise RecoverError(f"cannot recover {broken} into {out}: {error.strerror}") from None
    lost = [f"at byte {damage.offset}: {damage.what}" for damage in damages]
    return Recovery(out=str(out), messages=copy.messages, channels=len(copy.topics), lost=lost)
