"""Real-time set-up: what a loop needs is ready before its first tick."""

from __future__ import annotations

import ctypes
import errno
import gc
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from aeroloop.protocol.messages.operator import Message
from aeroloop.protocol.messages.topics import TOPICS
from aeroloop.protocol.runtime import realtime
from aeroloop.protocol.runtime.realtime import RealtimeError, prepare_process
from aeroloop.protocol.wire.loop import LoopSettings


def derived(base: type[Message]) -> Iterator[type[Message]]:
    for model in base.__subclasses__():
        yield model
        yield from derived(model)


def test_the_parser_of_every_message_is_built_before_the_first_tick() -> None:
    class Late(Message):
        tick: int

    assert not Late.__pydantic_complete__  # so at import, whatever other tests have used of the others
    prepare_process(LoopSettings(realtime="off"))
    models = set(derived(Message))
    assert {Late, *(topic.model for topic in TOPICS.values() if topic.model)} <= models
    assert all(model.__pydantic_complete__ for model in models)


PREPARED = """
import ctypes, gc, json, mmap, os
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.wire.loop import LoopSettings
refused = prepare_process(LoopSettings())
slack = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK [ns]

def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))

before = kilobytes("VmRSS")
untouched = mmap.mmap(-1, 64 << 20)
memory = [kilobytes("VmLck"), kilobytes("VmRSS") - before]
realtime = os.sched_getscheduler(0) == os.SCHED_FIFO
awake = "/dev/cpu_dma_latency" in [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")]
print(json.dumps([refused, gc.isenabled(), gc.get_freeze_count(), slack, realtime, memory, awake]))
"""

HEAP_GROWS = """
import json, resource
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.wire.loop import LoopSettings

def faults(run):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    run()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

prepare_process(LoopSettings())
kept = []
room = faults(lambda: kept.extend(bytes(8192) for _ in range(500)))
kept.clear()
again = faults(lambda: kept.extend(bytes(8192) for _ in range(500)))
beyond = faults(lambda: kept.extend(bytes(8192) for _ in range(5000)))
print(json.dumps([room, again, beyond]))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="only glibc's malloc can be set up so")
def test_what_a_loop_publishes_in_its_first_minute_costs_no_page_faults() -> None:
    done = subprocess.run([sys.executable, "-c", HEAP_GROWS], capture_output=True, text=True, timeout=60, check=True)
    room, again, beyond = json.loads(done.stdout)
    assert beyond > 5000  # what is counted: two pages each, and there is no room for so many
    assert max(room, again) < 50  # a few of Python's own; there are 1 000 pages


OBJECTS_GROW = """
import resource
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.wire.loop import LoopSettings

prepare_process(LoopSettings())
kept = []
before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
kept.extend(bytes(300) for _ in range(3000))
print(resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before)
"""

THREADS_GROW = """
import resource, threading
from aeroloop.protocol.runtime.realtime import prepare_process, share_heap
from aeroloop.protocol.wire.loop import LoopSettings

share_heap()
may_grow, grown = threading.Event(), []

def grow():
    may_grow.wait()
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    kept = [bytes(8192) for _ in range(100)]
    grown.append(resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before)

threads = [threading.Thread(target=grow) for _ in range(4)]
for thread in threads:
    thread.start()
prepare_process(LoopSettings())
may_grow.set()
for thread in threads:
    thread.join()
print(sum(grown))
"""

LIBRARY_WRITES = """
import resource
import numpy
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.wire.loop import LoopSettings

def faults():
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    for size in range(1024):  # numpy keeps the freed arrays of each size, in a table of 16 pages
        numpy.empty(size, numpy.int8)
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before

prepare_process(LoopSettings())
print(faults())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="only glibc's malloc can be set up so")
@pytest.mark.parametrize(
    ("code", "bound"),
    [
        pytest.param(OBJECTS_GROW, 20, id="Python's own heap grows: 220 pages"),
        pytest.param(THREADS_GROW, 100, id="other threads take memory: 800 pages"),
        pytest.param(LIBRARY_WRITES, 5, id="a library writes for the first time: 15 pages, read and then written"),
    ],
)
def test_what_comes_later_than_the_warm_up_costs_no_page_faults(code: str, bound: int) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert int(done.stdout) < bound


def test_a_prepared_process_is_as_it_reports() -> None:
    # In a process of its own: collector and scheduler are the process's, and pytest needs its own as they are.
    done = subprocess.run([sys.executable, "-c", PREPARED], capture_output=True, text=True, timeout=60, check=True)
    refused, collects, frozen, slack, fifo, (locked_kb, grown_kb), awake = json.loads(done.stdout)
    assert not collects
    assert frozen > 0
    reported = "\n".join(refused)
    assert ("timer slack" in reported) == (slack > 1)  # a real-time process may be shown 0
    assert ("SCHED_FIFO" in reported) == (not fifo)
    assert ("memory lock" in reported) == (locked_kb == 0)
    assert grown_kb < 32 << 10  # half of what was mapped and not touched: locked, but not resident
    assert len(refused) == (slack > 1) + (not fifo) + ("memory lock" in reported) + (not awake)
    assert ("idle CPUs sleep" in reported) == (not awake)


@pytest.fixture
def cpu_latency(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A file in place of the kernel's, which would keep CPUs awake until the tests end; the collector stays on."""
    file = tmp_path / "cpu_dma_latency"
    file.touch()
    monkeypatch.setattr(realtime, "_CPU_LATENCY", file)
    monkeypatch.setattr(gc, "disable", lambda: None)
    monkeypatch.setattr(gc, "freeze", lambda: None)
    return file


@pytest.mark.parametrize(("known", "called"), [(True, [7]), (False, [7, 3])])
def test_memory_is_locked_as_it_is_touched_or_at_once_where_the_kernel_is_older_than_4_4(
    monkeypatch: pytest.MonkeyPatch, cpu_latency: Path, known: bool, called: list[int]
) -> None:
    flags: list[int] = []

    class Libc:
        prctl = madvise = staticmethod(lambda *_: 0)

        @staticmethod
        def mlockall(value: int) -> int:
            flags.append(value)
            ctypes.set_errno(0 if known or value < 4 else errno.EINVAL)
            return 0 if known or value < 4 else -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)
    assert prepare_process(LoopSettings(realtime="try")) == []
    assert flags == called
    assert cpu_latency.read_bytes() == bytes(4)


def test_strict_names_what_is_refused_and_off_asks_for_nothing(
    monkeypatch: pytest.MonkeyPatch, cpu_latency: Path
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    class Libc:
        prctl = madvise = staticmethod(lambda *_: 0)
        mlockall = staticmethod(lambda *_: -1)

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc)
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert prepare_process(LoopSettings(realtime="off")) == []
    assert cpu_latency.read_bytes() == b""
    cpu_latency.unlink()
    refused = prepare_process(LoopSettings(realtime="try"))
    assert [line.split(":")[0] for line in refused] == ["memory lock", "SCHED_FIFO 10", "idle CPUs sleep"]
    with pytest.raises(RealtimeError, match="SCHED_FIFO"):
        prepare_process(LoopSettings(realtime="strict"))


def test_a_strict_process_starts_although_idle_cpus_may_sleep(
    monkeypatch: pytest.MonkeyPatch, cpu_latency: Path
) -> None:
    cpu_latency.unlink()

    class Libc:
        prctl = mlockall = madvise = staticmethod(lambda *_: 0)

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)
    [line] = prepare_process(LoopSettings(realtime="strict"))
    assert "idle CPUs sleep" in line
