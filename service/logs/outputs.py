"""Output files of all verbs: checked before they are written, complete or absent.

A log is never overwritten, and neither is an input of the command: by any name, link or relative path. Another
existing file is replaced only on request (`--force`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.writer import MCAP0_MAGIC as MAGIC

from aeroloop.protocol.errors import AeroloopError


class OutputError(AeroloopError):
    """An output cannot be written, or must not be; one line with the reason and what to do."""


def check_output(out: Path | None, inputs: Sequence[Path | None] = (), *, force: bool = False) -> None:
    """Raise OutputError if a file, if any, is a log, an input, no regular file, or exists and must not be replaced.

    `inputs` are files and folders that the command reads; None stands for an option that was not given.
    """
    try:
        if out is None or not out.exists():
            return
        if any(path is not None and path.exists() and path.samefile(out) for path in inputs):
            raise OutputError(f"{out} is an input of this command; name another file")
        if not out.is_file():
            raise OutputError(f"{out} is no regular file; name another file")
        with out.open("rb") as file:
            is_log = file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from None
    if is_log or out.resolve().suffix.lower() == ".mcap":
        raise OutputError(f"{out} is a log, and logs are never overwritten; name another file")
    if not force:
        raise OutputError(f"{out} exists already; name another file, or replace it with --force")


@contextmanager
def writing(out: Path, inputs: Sequence[Path | None] = (), *, force: bool = False) -> Iterator[Path]:
    """Path to write a new file to: becomes `out` on success, is removed on failure.

    Arguments are as of `check_output`. Raises OutputError if `out` must not be written, or cannot.
    """
    check_output(out, inputs, force=force)
    with _working_folder(out.resolve().parent, out) as folder:
        part = folder / out.name
        yield part
        check_output(out, inputs, force=force)
        part.replace(out.resolve())


@contextmanager
def writing_into(folder: Path, inputs: Sequence[Path | None] = (), *, force: bool = False) -> Iterator[Path]:
    """Folder to write new files into: they move into `folder` on success, all or none.

    Arguments are as of `check_output`. Raises OutputError if one of them must not be written, or cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write into {folder}: {error.strerror}") from None
    with _working_folder(folder, folder) as parts:
        yield parts
        targets = {part: folder / part.name for part in sorted(parts.iterdir())}
        for out in targets.values():
            check_output(out, inputs, force=force)
        for part, out in targets.items():
            part.replace(out.resolve())


@contextmanager
def _working_folder(parent: Path, out: Path) -> Iterator[Path]:
    """A new folder on the same disk, removed in the end."""
    try:
        with TemporaryDirectory(prefix=".aeroloop-", dir=parent) as folder:
            yield Path(folder)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror or error}") from None
