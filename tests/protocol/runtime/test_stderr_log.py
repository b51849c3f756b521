"""Log on a stderr that nobody reads: no message waits for it, what is dropped is counted and said, the process ends."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from aeroloop.protocol.runtime.stderr_log import WAITING
from tests.support.processes import FullPipe

LONGEST_S = 60.0  # the process takes a second; a hanging one takes for ever
MANY = WAITING + 500

LOGS = f"""
import logging, sys
from aeroloop.protocol.runtime.stderr_log import dropped_lines, flush_log, log_to_stderr
log_to_stderr()
log = logging.getLogger("aeroloop")
log.warning("umlauts: ü, %s", "\\udcff")
for i in range({MANY}):
    log.info("line %d", i)
print(dropped_lines(), flush=True)
sys.stdin.readline()
log.info("the last line", extra={{"role": "plant"}})
flush_log()
"""


@contextmanager
def logging_process(stderr: int) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", LOGS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_where_nobody_reads_messages_are_dropped_and_counted_and_the_process_goes_on_and_ends() -> None:
    with FullPipe() as pipe, logging_process(pipe.write_end) as process:
        assert process.stdout is not None
        dropped = int(process.stdout.readline())
        assert dropped in (MANY - WAITING, MANY + 1 - WAITING)  # one may be on its way already
        process.communicate("\n", timeout=LONGEST_S)
        assert process.returncode == 0


def test_once_it_is_read_again_a_line_says_how_many_were_dropped_and_the_log_goes_on() -> None:
    with FullPipe() as pipe, logging_process(pipe.write_end) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        dropped = int(process.stdout.readline())
        pipe.close_write_end()
        lines = pipe.read_lines(MANY + 1 - dropped)
        process.stdin.write("\n")
        process.stdin.flush()
        lines += pipe.read_lines(2)
        process.communicate(timeout=LONGEST_S)
    assert lines[0].endswith("umlauts: ü,  ")  # what is not printable is a space
    assert re.fullmatch(r"[-0-9]+ [:,0-9]+ WARNING aeroloop: umlauts: .*", lines[0])
    assert [line.rpartition(" ")[2] for line in lines[1:-2]] == [str(i) for i in range(MANY - dropped)]
    assert lines[-2].endswith(f" WARNING aeroloop: {dropped} lines of this log were dropped: nothing read stderr")
    assert lines[-1].endswith(" INFO plant: the last line")


def test_a_stderr_that_is_gone_costs_lines_and_nothing_else() -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    try:
        with logging_process(write_end) as process:
            output, _ = process.communicate("\n", timeout=LONGEST_S)
            assert process.returncode == 0
            assert int(output) > 0
    finally:
        os.close(write_end)


@pytest.mark.parametrize("text", ["all lines are written before the process ends"])
def test_the_end_of_a_process_waits_for_a_stderr_that_is_read(text: str) -> None:
    script = f"from aeroloop.protocol.runtime.stderr_log import *\nlog_to_stderr()\nlogging.info({text!r})\nflush_log()"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LONGEST_S, check=True)
    assert done.stderr.endswith(f" INFO aeroloop: {text}\n")
