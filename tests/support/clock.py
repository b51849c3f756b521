"""Fake clock, for whatever takes a `clock` argument: time passes by request, or by a sleep, which returns at once."""

from __future__ import annotations


class FakeClock:
    """A clock that moves when `now_ns` is set, by `advance`, or by a sleep, which may take `oversleep_ns` longer.

    Only `compute` takes time on a CPU.
    """

    def __init__(self, now_ns: int = 1_000_000_000_000) -> None:
        self.now_ns = now_ns
        self.oversleep_ns = 0
        self.cpu_s = 0.0
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        return self.now_ns

    def monotonic(self) -> float:
        return self.monotonic_ns() / 1e9

    def time_ns(self) -> int:
        return self.now_ns

    def thread_time(self) -> float:
        return self.cpu_s

    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def compute(self, seconds: float) -> None:
        self.advance(seconds)
        self.cpu_s += seconds

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9) + self.oversleep_ns
