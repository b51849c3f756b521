"""Wake-ups beside cyclictest: its histogram is read as numpy would read the samples."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.service.bench import wake_up

LENGTH = 60


def printed(samples: list[int]) -> str:
    """What cyclictest 2.4 prints of these latencies [µs], with a histogram of `LENGTH` bins."""
    counts = np.bincount(np.minimum(samples, LENGTH), minlength=LENGTH + 1)
    rows = [f"{us:06d} {count:06d}" for us, count in enumerate(counts[:LENGTH])]
    return "\n".join([
        "# /dev/cpu_dma_latency set to 0us",
        "# Histogram",
        *rows,
        f"# Min Latencies: {min(samples):05d}",
        f"# Histogram Overflows: {counts[LENGTH]:05d}",
        "# Histogram Overflow at cycle number:",
        "# Thread 0: 00289 00290 00291",
        "",
    ])  # fmt: skip


@given(st.lists(st.integers(0, 2 * LENGTH), min_size=1, max_size=300), st.floats(0.1, 100))
def test_a_percentile_of_cyclictest_is_that_of_its_samples_and_an_overflow_counts_as_the_last_bin(
    samples: list[int], percent: float
) -> None:
    exact = np.percentile(np.minimum(samples, LENGTH), percent, method="inverted_cdf")
    assert wake_up.percentile_of_cyclictest(printed(samples), percent) == exact


def test_no_histogram_is_no_percentile() -> None:
    assert wake_up.percentile_of_cyclictest("", 99.9) is None
    assert wake_up.percentile_of_cyclictest("# /dev/cpu_dma_latency set to 0us\n", 99.9) is None


def test_without_cyclictest_there_is_no_figure_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert wake_up.cyclictest_us(LoopSettings(), 0.1) is None
