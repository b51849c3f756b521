"""Doctor: checks whether this machine holds the configured rate, by the kernel's settings and a trial of a few seconds.

A finding is good or names what to change. The trial is a bare loop on the grid, with the same real-time set-up as the
daemons; it shows the machine's part of the jitter, to which Zenoh adds its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import Percentiles
from aeroloop.protocol.runtime.host import host_facts
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.runtime.timing import LoopTiming, TickGrid
from aeroloop.protocol.transport.certificate import SOON_DAYS, CertificateError, read_certificate
from aeroloop.protocol.transport.network import PLAIN_S, accepting, refusal
from aeroloop.protocol.transport.network_settings import PORTS, Endpoint, NetworkSettings, opened
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.host.health import LATE_SHARE

CHECK_S: Final = 5.0
"""Duration of the trial [s]; it is judged as `op status --check` judges a loop's last 10 s."""
GOOD_CLOCKS: Final = ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page")
SHARE_OF_PERIOD: Final = 0.25
"""Latest wake-up, as a share of the period; after it too little time is left for two crossings of the network."""


@dataclass(frozen=True)
class Finding:
    """One thing that was checked, and what to change where it is not good."""

    what: str
    good: bool
    found: str
    advice: str = ""


class Diagnosis(BaseModel, frozen=True):
    """All findings and the trial."""

    holds: bool = Field(description="whether the trial kept the configured rate")
    rate_hz: float
    skipped: int
    wake_us: Percentiles | None
    findings: list[Finding]


def diagnose(
    loop: LoopSettings,
    progress: Callable[[float], None] | None = None,
    keys: Path | None = None,
    network: NetworkSettings | None = None,
) -> Diagnosis:
    """Check the settings and certificates, then run the trial.

    Args:
        loop: The rate, and how the daemons are set up.
        progress: Called five times a second with the trial's elapsed time [s].
        keys: Directory of this host's certificates; None if there is none.
        network: Where to try the certificates; None: nowhere.

    Raises:
        NetworkError, CertificateError: The network's links cannot be secured.
    """
    findings = [
        *_settings(),
        *(certificate_findings(keys) if keys else ()),
        *(network_findings(network) if network else ()),
    ]
    refusals = prepare_process(loop.model_copy(update={"realtime": "try"}))
    if not refusals:
        findings.append(Finding("real-time set-up", True, "SCHED_FIFO, locked memory, awake CPUs"))
    for line in refusals:
        awake = "let the user write to it, or use tuned's profile latency-performance"
        limits = "run it as a unit of `aeroloop host units`, or raise the user's limit in /etc/security/limits.d"
        findings.append(Finding("real-time set-up", False, line, awake if "CPUs sleep" in line else limits))
    timing, grid = LoopTiming(warm_up_ns=500_000_000), TickGrid(loop.period_ns)
    ticks, report_every = loop.ticks(CHECK_S), max(1, loop.ticks(0.2))
    while grid.tick < ticks:
        k = grid.wait()
        timing.woke(grid.due_ns)
        if progress is not None and k % report_every == 0:
            progress(k * loop.period)
        timing.done()
    wake = timing.wake.total.summary()
    limit_us = SHARE_OF_PERIOD * loop.period_ns / 1000
    late = wake is None or wake.p99 > limit_us
    trial = Finding(
        f"{CHECK_S:g} s at {loop.rate_hz:g} Hz",
        not late and grid.skipped <= LATE_SHARE * ticks,
        f"{grid.skipped} of {ticks} ticks skipped, 99 % of wake-ups within {wake.p99 if wake else float('nan'):.0f} µs",
        f"want at most {100 * LATE_SHARE:g} % skipped and {limit_us:.0f} µs: lower loop.rate_hz, free or isolate a CPU "
        "(loop.cpus), or use a kernel with PREEMPT_RT",
    )
    return Diagnosis(
        holds=trial.good, rate_hz=loop.rate_hz, skipped=grid.skipped, wake_us=wake, findings=[*findings, trial]
    )


def certificate_findings(directory: Path) -> Iterator[Finding]:
    """The authority and this host's certificates: whether they can be used, and for how long."""
    from aeroloop.service.host.keys import show  # imports `cryptography`

    try:
        rows = show(directory)
    except CertificateError as error:
        yield Finding("certificates", False, "no authority", str(error))
        return
    for row in rows:
        days = row.days_left
        yield Finding(
            row.file,
            row.problem is None and days is not None and days >= SOON_DAYS,
            "no certificate of a role" if days is None else f"{days:.0f} days left",
            row.problem or "move it and its key away, `aeroloop host keys issue` it anew, and restart",
        )


def network_findings(network: NetworkSettings) -> Iterator[Finding]:
    """A handshake with each configured place, by each usable certificate of this host; of several ports, all.

    Raises:
        NetworkError, CertificateError: The network's links cannot be secured.
    """
    from aeroloop.service.host.keys import show

    folder = network.security.folder
    rows = show(folder)[1:] if folder else []
    usable = [read_certificate(folder / row.file) for row in rows if folder and row.problem is None]
    for text in [*network.rendezvous, *network.connect]:
        place, several = opened(text, network), network.mode == "peer" and text in network.rendezvous
        answering = accepting([str(each) for each in Endpoint.parse(place).ports(PORTS if several else 1)])
        tries = [(port, certificate) for port in answering for certificate in usable]
        with ThreadPoolExecutor(max(1, len(tries))) as pool:
            lines = list(pool.map(lambda each: refusal(each[0], each[1], PLAIN_S), tries))
        refused = [(port, each.file.name, line) for (port, each), line in zip(tries, lines, strict=True) if line]
        for port, name, line in refused:
            yield Finding(name, False, f"refused at {port}", line)
        if not answering:
            yield Finding(place, False, "no process answers", "start one there, and let TCP through to it")
        elif not refused:
            yield Finding(
                place, True, "answers" + (f", and refuses none of {len(usable)} certificates" if usable else "")
            )


def _settings() -> Iterator[Finding]:
    """The kernel's settings, as far as the trial's own set-up does not show them."""
    clock, governor = map(host_facts().get, ("clock", "governor"))
    yield Finding(
        "clock source",
        clock in GOOD_CLOCKS,
        clock or "not reported by this kernel",
        "reading the clock may be slow; boot with clocksource=tsc if the CPU has a stable one",
    )
    yield Finding(
        "CPU frequency",
        governor in (None, "performance"),
        governor or "not scaled by this kernel",
        "set the governor to performance: cpupower frequency-set -g performance",
    )
