"""Coverage-guided fuzzing of what strangers send: `uv run --with atheris python -m tests.benchmarks.fuzz PART`.

PART is `frames`, `messages` or `batches`; further words are libFuzzer's, such as `-max_total_time=60`. What is given is
parsed, and must be refused or taken: any exception but the one that is promised ends the run with
the bytes that caused it. Not a dependency: atheris has no wheels for every Python.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Final

import atheris

with atheris.instrument_imports(include=["aeroloop.protocol", "json"]):
    from aeroloop.protocol.messages.operator import MessageError
    from aeroloop.protocol.messages.trace import read_batch
    from aeroloop.protocol.wire.frames import FrameFormat
    from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
    from tests.support.every_message import MESSAGES

MODELS: Final = sorted({type(message) for message in MESSAGES}, key=lambda model: model.__name__)
_FREE: Final = SignalSpec(bits=None, limit=1.0)
_SPECS: Final = (WireSpec(), WireSpec(actuators=3), WireSpec(rate=_FREE), WireSpec(attitude=_FREE, rate=_FREE))
FORMATS: Final[list[FrameFormat]] = [form for spec in _SPECS for form in (spec.measurement, spec.command)]


def frames(data: bytes) -> None:
    """The first byte chooses the format. What is well-formed packs to the same bytes, but for a NaN's."""
    form = FORMATS[data[0] % len(FORMATS)] if data else FORMATS[0]
    found = form.unpack(data[1:])
    if found is not None and all(code == code for code in found[1]):
        assert form.pack(*found) == data[1:]


def messages(data: bytes) -> None:
    """The first byte chooses the model."""
    try:
        (MODELS[data[0] % len(MODELS)] if data else MODELS[0]).decode(data[1:])
    except MessageError as error:
        if len(str(error).splitlines()) != 1:
            raise ValueError(f"not one line: {error}") from None


def batches(data: bytes) -> None:
    """Batches of a trace."""
    read_batch(data)


PARTS: Final[dict[str, Callable[[bytes], None]]] = {part.__name__: part for part in (frames, messages, batches)}


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in PARTS:
        sys.exit(f"name a part: {', '.join(PARTS)}")
    atheris.Setup([sys.argv[0], *sys.argv[2:]], PARTS[sys.argv[1]])
    atheris.Fuzz()
