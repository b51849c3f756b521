"""Terminal table of a wire spec, for `show spec`."""

from __future__ import annotations

from functools import partial

from rich.console import Console
from rich.table import Column, Table

from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, Quantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import WireSpec


def wire_table(wire: WireSpec) -> None:
    """Print a wire spec: each signal's quantizer, each frame's size."""
    console = Console()
    fold, gap = partial(Column, overflow="fold"), 2 if console.width >= 80 else 1
    columns = (
        Column("signal", no_wrap=True),
        fold("kind"),
        "bits",
        "limit",
        fold("step"),
        fold("largest\nerror"),
        "unit",
    )
    table = Table(*columns, box=None, padding=(0, gap, 0, 0))
    signals = (("ε attitude", wire.attitude, ""), ("ω rate", wire.rate, "rad/s"), ("u voltage", wire.voltage, "V"))
    notes = list[str]()
    for name, signal, unit in signals:
        quantizer = signal.quantizer()
        step, note = _steps(quantizer, f" {unit}".rstrip())
        if note is not None:
            notes.append(f"{name}: {note}")
        kind, bits = ("–", "cont") if signal.bits is None else (signal.kind, str(signal.bits))
        table.add_row(name, kind, bits, f"±{signal.limit:g}", step, f"{quantizer.bound:.6g}", unit or "1")
    console.print(table)
    for note in notes:
        console.print(note, highlight=False)
    for label, frame in (("measurement", wire.measurement), ("command", wire.command)):
        console.print(f"{label}: {frame.bits} bits in {frame.size} bytes, {frame.counter_bits} of them the counter")


def _steps(quantizer: Quantizer, unit: str) -> tuple[str, str | None]:
    """The step between levels, and a note on the kind's other parameters."""
    if isinstance(quantizer, LogarithmicQuantizer):
        least = quantizer.edges[1] - quantizer.edges[0]
        return f"≤ {quantizer.step:.6g}", (
            f"0 within ±{quantizer.deadzone:.6g}{unit}, then {quantizer.growing} steps that grow from {least:.3g}{unit}"
            f" up to ±{quantizer.threshold:.6g}{unit}, and {quantizer.top - quantizer.growing} alike"
        )
    if isinstance(quantizer, HysteresisQuantizer):
        note = f"a level is held for {quantizer.hysteresis:.6g}{unit} beyond its interval"
        return f"{quantizer.step:.6g}", note
    return (f"{quantizer.step:.6g}" if isinstance(quantizer, UniformQuantizer) else "–"), None
