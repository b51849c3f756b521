"""Wire spec as text: each signal's quantizer, each frame's size, for `show spec`."""

from __future__ import annotations

from collections.abc import Iterator

from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, Quantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.terminal.show import Row


def wire_sheets(wire: WireSpec) -> Iterator[tuple[str, list[Row]]]:
    """A wire spec as a table and paragraphs."""
    rows, notes = list[Row](), list[str]()
    for name, signal, unit in (
        ("ε attitude", wire.attitude, ""),
        ("ω rate", wire.rate, "rad/s"),
        ("u voltage", wire.voltage, "V"),
    ):
        quantizer = signal.quantizer()
        step, note = _steps(quantizer, f" {unit}".rstrip())
        if note is not None:
            notes.append(f"{name}: {note}")
        kind, bits = ("–", "cont") if signal.bits is None else (signal.kind, str(signal.bits))
        limit, error = f"±{signal.limit:g}", f"{quantizer.bound:.6g}"
        rows.append(
            {"signal": name, "kind": kind, "bits": bits, "limit": limit, "step": step, "largest error": error}
            | {"unit": unit or "1"}
        )
    yield "", rows
    for label, frame in (("measurement", wire.measurement), ("command", wire.command)):
        notes.append(f"{label}: {frame.bits} bits in {frame.size} bytes, {frame.counter_bits} of them the counter")
    yield "\n".join(notes), []


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
