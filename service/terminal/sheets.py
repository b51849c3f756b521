"""Results as tables and paragraphs for `show`: certificate, wire, diagnosis of a machine, keys of a host."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, Quantizer, UniformQuantizer
from aeroloop.service.terminal.show import Row, Sheets

if TYPE_CHECKING:
    from aeroloop.protocol.wire.spec import WireSpec
    from aeroloop.service.host.doctor import Diagnosis
    from aeroloop.service.host.keys import KeyFile
    from aeroloop.service.theorem.certificate import Certificate

DECIDING: Final = (
    "‖δ_ε‖", "‖δ_ω‖", "‖δ_u‖", "max ‖θ̃‖", "δ_V1", "c₀/2 − δ_V1", "‖w_s‖", "‖w_f‖", "‖w_q‖", "τ_h of the plant"
)  # fmt: skip
"""Symbols of a certificate's terms that are shown unless --verbose: what goes in, what decides, what comes out."""


def certificate_sheets(certificate: Certificate, verbose: bool = False) -> Sheets:
    """A certificate, with all of its terms if verbose."""
    yield "\n  ".join([certificate.verdict, *certificate.violated[1:]]), []
    proven = (
        ("paper's body, at every instant", certificate.pointwise_radius, certificate.pointwise_deg),
        ("configured plant, at every instant", certificate.plant_radius, certificate.plant_deg),
        ("the same with θ̂ as first estimated", certificate.constant_radius, None),
    )
    yield (
        "",
        [
            {
                "proven, in the end": what,
                "‖z‖": "not proven" if radius is None else f"{radius:.4g}",
                "attitude": "" if angle is None else f"{angle:.2f}°",
            }
            for what, radius, angle in proven
        ],
    )
    if certificate.delay_ms is not None:
        lost = "" if certificate.lost_frames is None else f", or {certificate.lost_frames} frames lost in a row"
        yield f"It still holds with {certificate.delay_ms:.1f} ms of further delay{lost}.", []
    yield "\n  ".join(["Assumed:", *certificate.assumptions]), []
    yield (
        "",
        [
            {
                "symbol": term.symbol,
                "value": "–" if term.value is None else f"{term.value:.4g}",
                "unit": term.unit,
                "meaning": f"{term.meaning} ({term.equation})" if verbose else re.split("[;,]", term.meaning)[0],
            }
            for term in certificate.terms
            if verbose or term.symbol in DECIDING
        ],
    )
    if not verbose:
        yield f"--verbose prints all {len(certificate.terms)} terms, with their equations.", []


def wire_sheets(wire: WireSpec) -> Sheets:
    """A wire spec: each signal's quantizer, each frame's size."""
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


def diagnosis_sheets(diagnosis: Diagnosis) -> Sheets:
    """Findings of the doctor, each with what to change, and the verdict."""
    yield (
        "",
        [
            {
                "": "✓" if finding.good else "✗",
                "checked": finding.what,
                "found": finding.found,
                "to change": "" if finding.good else finding.advice,
            }
            for finding in diagnosis.findings
        ],
    )
    yield f"this machine {'holds' if diagnosis.holds else 'does not hold'} {diagnosis.rate_hz:g} Hz", []


def key_sheets(folder: str, files: Sequence[KeyFile]) -> Sheets:
    """Certificates of a folder, and a line for each that cannot be used."""
    yield (
        folder,
        [
            {
                "": "✗" if file.problem else "✓",
                "file": file.file,
                "role": file.role or "–",
                "vehicle": file.vehicle or ("every" if file.role and file.role != "authority" else "–"),
                "name": file.name or "–",
                "valid until": f"{file.valid_until:%Y-%m-%d}" if file.valid_until else "–",
                "days left": f"{file.days_left:.{0 if abs(file.days_left) >= 1 else 1}f}" if file.days_left else "–",
            }
            for file in files
        ],
    )
    if problems := [file.problem for file in files if file.problem]:
        yield "\n".join(problems), []
