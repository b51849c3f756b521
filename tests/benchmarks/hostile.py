"""Hostile data in numbers: `uv run python -m tests.benchmarks.hostile [PART ...]`, parts as in `PARTS`.

10⁶ random frames of four wire specs, 10⁵ mutated messages against every model, 10⁴ mutated batches of traces, 200
mutated configurations, 200 damaged logs and bombs of zstd and lz4. The last three are given to the command line, each
in a process of its own. What fails is printed: another exception than the error that is promised, a traceback, a
process that takes more than `MOST_S` of CPU or grows by more than `MOST_MB`. The exit code is 1 if anything does.
"""

from __future__ import annotations

import os
import resource
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from random import Random
from typing import Final

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC as MAGIC

from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.trace import read_batch
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings
from tests.support.every_message import MESSAGES
from tests.support.hostile import mutated
from tests.support.made_log import make_log

SEED: Final = 18
FRAMES: Final = 1_000_000
PAYLOADS: Final = 100_000
BATCHES: Final = 10_000
CONFIGURATIONS: Final = 200
LOGS: Final = 200
MOST_S: Final = 30
MOST_MB: Final = 400
"""What one reader of a log may hold: a chunk of `MAX_CHUNK`, decompressed, copied and parsed."""
CODES: Final = range(3)
"""Exit codes of the command line: done, failed, wrongly called."""

_HEAD: Final = struct.Struct("<BQ")

Failures = Iterator[str]


def frames(chance: Random) -> Failures:
    """Random frames, of the right length and others."""
    free = SignalSpec(bits=None, limit=1.0)
    specs = [WireSpec(), WireSpec(attitude=free, rate=free, voltage=free), WireSpec(actuators=3), WireSpec(rate=free)]
    accepted = 0
    for number in range(FRAMES):
        spec = specs[number % len(specs)]
        form = spec.measurement if number % 8 < 4 else spec.command
        frame = chance.randbytes(form.size if chance.random() < 0.8 else chance.randrange(64))
        try:
            accepted += form.unpack(frame) is not None
        except Exception as error:
            yield f"frame {frame.hex()}: {error!r}"
    print(f"{FRAMES} frames, {accepted} of them well-formed by chance")


def messages(chance: Random) -> Failures:
    """Mutated messages, each against its own model and another one."""
    models = sorted({type(message) for message in MESSAGES}, key=lambda model: model.__name__)
    refused, slowest = 0, 0.0
    for number in range(PAYLOADS):
        message = MESSAGES[number % len(MESSAGES)]
        payload = mutated(message.encode(), chance)
        model = type(message) if number % 2 else chance.choice(models)
        begun = time.thread_time()
        try:
            model.decode(payload)
        except MessageError as error:
            refused += 1
            if len(str(error).splitlines()) != 1:
                yield f"{model.__name__} {payload!r}: {error}"
        except Exception as error:
            yield f"{model.__name__} {payload!r}: {error!r}"
        slowest = max(slowest, time.thread_time() - begun)
    print(f"{PAYLOADS} messages, {refused} refused, the slowest in {slowest * 1e3:.1f} ms")


def batches(chance: Random) -> Failures:
    """Mutated batches of traces."""
    with tempfile.TemporaryDirectory() as folder:
        whole = _a_batch(Path(folder) / "whole.mcap")
    refused = 0
    for _ in range(BATCHES):
        payload = mutated(whole, chance)
        try:
            refused += read_batch(payload) is None
        except Exception as error:
            yield f"batch {payload.hex()}: {error!r}"
    print(f"{BATCHES} batches, {refused} refused")


def configurations(chance: Random) -> Failures:
    """Mutated configurations, shown by the command line."""
    whole = Settings().toml().encode()
    with tempfile.TemporaryDirectory() as folder:
        path, codes = Path(folder) / "aeroloop.toml", Counter[int]()
        for number in range(CONFIGURATIONS):
            path.write_bytes(mutated(whole, chance))
            yield from _tried(["show", "config", "--config", str(path)], f"configuration {number}", codes)
    print(f"{CONFIGURATIONS} configurations: exit codes {dict(codes)}")


def logs(chance: Random) -> Failures:
    """Damaged logs: half cut at a random byte, half with up to fifty flipped bits."""
    with tempfile.TemporaryDirectory() as folder:
        whole = _a_log(Path(folder) / "whole.mcap")
        codes = Counter[int]()
        for number in range(LOGS):
            data = bytearray(whole)
            if number % 2:
                del data[chance.randrange(len(data)) :]
            else:
                for _ in range(chance.randint(1, 50)):
                    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
            yield from _every_reader(Path(folder), bytes(data), f"log {number}", codes)
    print(f"{LOGS} logs, each by {len(_READERS)} verbs: exit codes {dict(codes)}")


def bombs(_: Random) -> Failures:
    """Logs of some hundred kilobytes that claim or hold gigabytes."""
    zeros = bytes(64 << 20)
    dense = {"zstd": zstandard.compress(zeros), "lz4": lz4.frame.compress(zeros)}
    with tempfile.TemporaryDirectory() as folder:
        whole, codes = _a_log(Path(folder) / "whole.mcap"), Counter[int]()
        first = _first_chunk(whole)
        for kind, data in dense.items():
            for claim in (len(zeros), 1000, 1 << 40, (1 << 63) - 1):
                builder = RecordBuilder()
                Chunk(kind, data, 1, 0, 0, claim).write(builder)
                block = bytes(builder.end())
                text = f"{kind} bomb that claims {claim} bytes"
                yield from _every_reader(Path(folder), whole[:first] + block * 20 + whole[first:], text, codes)
                yield from _every_reader(Path(folder), whole + block * 20, text, codes)
    print(f"bombs of {[len(data) for data in dense.values()]} bytes a chunk: exit codes {dict(codes)}")


def _first_chunk(log: bytes) -> int:
    at = len(MAGIC)
    while (record := _HEAD.unpack_from(log, at))[0] != Opcode.CHUNK:
        at += _HEAD.size + record[1]
    return at


_READERS: Final = (
    ("log", "review", "{log}"),
    ("log", "replay", "{log}"),
    ("log", "recover", "{log}", "--out", "{folder}/recovered.mcap", "--force"),
    ("log", "export", "{log}", "--to", "csv", "--out", "{folder}/table.csv", "--force"),
)


def _every_reader(folder: Path, data: bytes, title: str, codes: Counter[int]) -> Failures:
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    for words in _READERS:
        given = [word.format(log=path, folder=folder) for word in words]
        yield from _tried(given, f"{title}, {words[1]}", codes)


def _tried(words: Sequence[str], title: str, codes: Counter[int]) -> Failures:
    """Run a command of the program in a fork of this process, which has imported it."""
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if not child:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S))
            os._exit(execute(list(words)))
        _, status, used = os.wait4(child, 0)
        output.seek(0)
        said = output.read().decode(errors="replace")
    code = os.waitstatus_to_exitcode(status)
    codes[code] += 1
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown_mb = (used.ru_maxrss - own) / 1024
    if code == -signal.SIGXCPU or code == -signal.SIGKILL:
        yield f"{title}: took more than {MOST_S} s"
    elif code not in CODES or "Traceback" in said or "unexpected" in said:
        yield f"{title}: exit code {code}: {said[-500:]}"
    if grown_mb > MOST_MB:
        yield f"{title}: grew by {grown_mb:.0f} MB"


def _a_log(path: Path) -> bytes:
    make_log(path, 1500)
    with redirect_stdout(StringIO()):
        execute(["log", "review", str(path)])  # forks need not import what it needs
        execute(["log", "replay", str(path)])
    return path.read_bytes()


def _a_batch(path: Path) -> bytes:
    from aeroloop.service.logs.mcap_file import messages as logged

    make_log(path, 300)
    found = logged(path, lambda channel: True if "/trace/" in channel.topic else None)
    return next(found)[1].data


PARTS: Final[dict[str, Callable[[Random], Failures]]] = {
    part.__name__: part for part in (frames, messages, batches, configurations, logs, bombs)
}


def main(names: Sequence[str]) -> int:
    """Run the parts, print what fails, and return the exit code."""
    failed = 0
    for name in names or PARTS:
        begun = time.process_time()
        for failure in PARTS[name](Random(SEED)):
            failed += 1
            print(f"FAILED {failure}", flush=True)
        print(f"  {name}: {time.process_time() - begun:.0f} s of CPU", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
