"""Synthetic report: a small, constant example of every part of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aeroloop.protocol.messages.models import Percentiles
from aeroloop.service.figures import StreamFigures
from aeroloop.service.review.report import (
    Check,
    FaultInterval,
    Findings,
    Gap,
    Line,
    Mark,
    Panel,
    Report,
    Spread,
    TheoremFindings,
)

HELD = Check(text="z_track ≤ 0.005 s", holds=True, found="0.00458 s")
HOSTILE = """</script><script>window.hit = 1</script><img src=x onerror="window.hit = 1">&amp;<!--"""
MARKS = (
    Mark(time_s=None, kind="started", role="controller", text="controller aero-1 on host h"),
    Mark(time_s=3.0, kind="changed", role="controller", text="gains: C2 = 0.2 0.2 0.2"),
    Mark(time_s=7.25, kind="tripped", role="emulator", text="no fresh command for 100 ms: 0 V"),
)


def made_report(
    name: str = "a.mcap",
    *,
    marks: Sequence[Mark] = MARKS,
    checks: Sequence[Check] = (),
    damages: Sequence[str] = (),
    settings: dict[str, Any] | None = None,
    thinned: int = 1,
    phase: float = 0.0,
    theorem: TheoremFindings | None = None,
) -> Report:
    """Ten seconds of sines, with one trip and one gap; `phase` is that of the measured lines [rad]."""
    time = np.linspace(0.0, 10.0, 501)
    desired, measured = np.sin(time), np.sin(time - phase) + 0.02 * np.cos(31 * time)
    tenth = np.where(np.arange(501) % 10 == 0, measured, np.nan)
    panels = [
        *(
            Panel("attitude", "Figure C.7: Attitude with quantization", label, "1",
                  [Line("measured", np.cos(time) if label == "η" else measured),
                   Line("desired", desired, desired=True)])
            for label in ("η", "ε₁", "ε₂", "ε₃")
        ),
        Panel("error", "Figure C.9: Attitude error with quantization", "ε̃₁", "1",
              [Line("measured", measured)]),
        Panel("input", "Figure C.11: Input with quantization", "u₂", "V", [Line("commanded", 20 * measured)]),
        Panel("damping_estimate", "Damping estimate", "θ̂₁", "N·m·s/rad", [Line("estimated", tenth)]),
        Panel("latency", "Loop latency", "latency", "ms", [Line("latency", np.where(measured > 1.01, 90.0, 0.6))]),
    ]  # fmt: skip
    if theorem is not None:
        panels.append(Panel("theorem", "Error of Theorem 1", "‖z‖", "1", [Line("measured", np.abs(measured))]))
    spread = Spread(count=854, p50=640.0, p90=690.0, p99=2400.0, p999=5900.0, max=6011.0)
    findings = Findings(
        log=name, vehicle="aero", session="s1", sessions=1, started="2026-11-21T12:11:49.588+00:00", duration_s=10.0,
        z_track=0.00458, u_total=8185.2, max_error_deg=4.84, final_error_deg=0.46, skipped_ticks=50,
        measurement=StreamFigures(frames_per_s=499.1, bits_per_s=27952.0),
        command=StreamFigures(frames_per_s=498.3, bits_per_s=7972.0),
        latency_us=Percentiles(count=854, p50=640.0, p99=2400.0, p999=5900.0, max=6011.0),
        timing={"latency": spread, "period": spread},
        trips=[mark.text for mark in marks if mark.kind == "tripped"], damages=list(damages),
        gaps=[Gap(time_s=7.2, tick=3600, ticks=50)], gap_count=1, losses={}, lapses={}, missing=[],
        saturated={"attitude": 0.0, "rate": 0.013, "voltage": 0.0}, invalid={"measurement": 0, "command": 2},
        missing_ticks={"controller": 0, "plant": 0}, marks=list(marks), checks=list(checks), theorem=theorem,
    )  # fmt: skip
    usual = {"vehicle": "aero", "loop": {"rate_hz": 500.0, "lockstep": False}, "law": {"C2": [0.15, 0.15, 0.15]}}
    facts: dict[str, dict[str, Any]] = {"controller": {"host": "h", "versions": {"aeroloop": "0.1.0"}}}
    return Report(name, findings, time, panels, thinned, usual | (settings or {}), facts)


def with_faults(report: Report, *faults: tuple[str, float, float | None]) -> Report:
    """A report with faults of the plant: what, from when, until when [s]."""
    intervals = [
        FaultInterval(fault=fault, source="injected", begin_s=begin_s, end_s=end_s, changed=1, effect="samples shifted")
        for fault, begin_s, end_s in faults
    ]
    return replace(report, findings=report.findings.model_copy(update={"faults": intervals}))


def made_theorem(*, share: float = 0.52) -> TheoremFindings:
    """A theorem that holds of a run, whose ‖z‖ had this share of its bound."""
    return TheoremFindings(
        verdict="Holds: once there, ‖z‖ stays within 0.2004.", held=share <= 1, holds=True, pointwise_radius=0.2004,
        pointwise_deg=23.01, pointwise_share=share, pointwise_at_s=1.5, pointwise_judged=450, pointwise_since_s=1.0,
        pointwise_bound=0.21, since_s=0.0, until_s=8.5, samples=500,
    )  # fmt: skip
