"""Rounds of an attack, in memory and in a file of JSON lines, from which a search resumes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import BaseModel, ValidationError

from aeroloop.protocol.errors import AeroloopError

WorstInstants: TypeAlias = dict[str, tuple[float, list[float]]]
"""Of each inequality: left over right side, and the instant."""


class AttackError(AeroloopError):
    """A search cannot begin or resume; one line with the reason."""


class Round(BaseModel):
    """A line of the file: the points of a round, what they reached, and each inequality's worst instant so far."""

    points: list[list[float]]
    reached: dict[str, list[float]]
    instants: WorstInstants


class Rounds:
    """Rounds so far, in a file if one is given: its first line says of which search."""

    def __init__(self, path: Path | None, head: dict[str, Any]) -> None:
        self.rounds = list[Round]()
        self._path = path
        if path is None:
            return
        try:
            if not path.exists():
                path.write_bytes(json.dumps(head).encode() + b"\n")
            first, *lines = path.read_bytes().splitlines(keepends=True) or [b""]
            if json.loads(first) != head:
                raise AttackError(f"{path} holds a search of another configuration, seed or length: name another file")
            if lines and not lines[-1].endswith(b"\n"):  # cut off while it was written: this round is run again
                os.truncate(path, path.stat().st_size - len(lines.pop()))
            self.rounds += [Round.model_validate_json(line) for line in lines]
        except OSError as error:
            raise AttackError(f"{path} cannot be used: {error.strerror}") from None
        except (json.JSONDecodeError, UnicodeDecodeError, ValidationError):
            raise AttackError(f"{path} does not hold a search: name another file") from None

    def append(self, done: Round) -> None:
        """Add a round, to the file as well."""
        self.rounds.append(done)
        if self._path is not None:
            with self._path.open("ab") as file:
                file.write(done.model_dump_json().encode() + b"\n")
