"""Memory of daemons: read from /proc by name, in MB of 10⁶ bytes."""

from __future__ import annotations

import mmap
import os
import threading
from pathlib import Path

import pytest

from aeroloop.service.bench.memory import faults, megabytes

STATUS = "VmHWM:\t  200000 kB\nVmRSS:\t  109768 kB\nRssAnon:\t   64000 kB\nVmLck:\t       0 kB\n"


def test_a_quantity_is_found_by_its_whole_name() -> None:
    assert megabytes(STATUS, "VmRSS") == pytest.approx(112.402432)
    assert megabytes(STATUS, "VmLck") == 0
    with pytest.raises(ValueError, match="RSS is not in"):
        megabytes(STATUS, "RSS")


def test_this_process_is_as_large_as_the_kernel_says_in_pages() -> None:
    before = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") * 1e-6
    resident = megabytes(Path("/proc/self/status").read_text(), "VmRSS")
    shared = megabytes(Path("/proc/self/smaps_rollup").read_text(), "Pss")
    assert resident == pytest.approx(before, rel=0.05)  # it grows by what this test touches
    assert 0 < shared <= resident * 1.05


def test_page_faults_of_every_thread_are_counted() -> None:
    pages = 200
    before = faults(Path("/proc/self"))
    thread = threading.Thread(target=lambda: mmap.mmap(-1, pages * mmap.PAGESIZE).write(bytes(pages * mmap.PAGESIZE)))
    thread.start()
    thread.join()
    assert faults(Path("/proc/self")) - before >= pages
