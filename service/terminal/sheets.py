"""Results as tables and paragraphs for `show`: certificate, wire, diagnosis of a machine, keys of a host."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, UniformQuantizer
from aeroloop.service.terminal.show import Row, Sheets, paragraph

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
    bounds: list[Row] = []
    for what, radius, angle in proven:
        found = {"‖z‖": "not proven" if radius is None else f"{radius:.4g}"}
        bounds.append({"proven, in the end": what, **found, "attitude": "" if angle is None else f"{angle:.2f}°"})
    yield "", bounds
    if certificate.delay_ms is not None:
        lost = "" if certificate.lost_frames is None else f", or {certificate.lost_frames} frames lost in a row"
        yield f"It still holds with {certificate.delay_ms:.1f} ms of further delay{lost}.", []
    yield "\n  ".join(["Assumed:", *certificate.assumptions]), []
    terms: list[Row] = []
    for term in certificate.terms:
        if verbose or term.symbol in DECIDING:
            value = "–" if term.value is None else f"{term.value:.4g}"
            meaning = f"{term.meaning} ({term.equation})" if verbose else re.split("[;,]", term.meaning)[0]
            terms.append({"symbol": term.symbol, "value": value, "unit": term.unit, "meaning": meaning})
    yield "", terms
    if not verbose:
        yield f"--verbose prints all {len(certificate.terms)} terms, with their equations.", []


def wire_sheets(wire: WireSpec) -> Sheets:
    """A wire spec: each signal's quantizer, each frame's size."""
    rows, notes = list[Row](), list[str]()
    for name, signal, unit in (
        ("ε attitude", wire.attitude, "1"),
        ("ω rate", wire.rate, "rad/s"),
        ("u voltage", wire.voltage, "V"),
    ):
        quantizer, step = signal.quantizer(), "–"
        if isinstance(quantizer, UniformQuantizer | LogarithmicQuantizer):
            step = f"{quantizer.step:.6g}"
        if isinstance(quantizer, LogarithmicQuantizer):
            grows = f"{quantizer.growing} steps grow from {quantizer.edges[1] - quantizer.edges[0]:.3g} {unit}"
            notes.append(f"{name}: {grows} up to ±{quantizer.threshold:.6g} {unit}, the others are alike")
        elif isinstance(quantizer, HysteresisQuantizer):
            notes.append(f"{name}: a level is held for {quantizer.hysteresis:.6g} {unit} beyond its interval")
        kind, bits = ("–", "cont") if signal.bits is None else (signal.kind, str(signal.bits))
        row = {"signal": name, "kind": kind, "bits": bits, "limit": f"±{signal.limit:g}", "step": step}
        rows.append(row | {"largest error": f"{quantizer.bound:.6g}", "unit": unit})
    yield "", rows
    for label, frame in (("measurement", wire.measurement), ("command", wire.command)):
        notes.append(f"{label}: {frame.bits} bits in {frame.size} bytes, {frame.counter_bits} of them the counter")
    yield paragraph(notes), []


def diagnosis_sheets(diagnosis: Diagnosis) -> Sheets:
    """Findings of the doctor, each with what to change, and the verdict."""
    found: list[Row] = []
    for finding in diagnosis.findings:
        sign, advice = ("✓", "") if finding.good else ("✗", finding.advice)
        found.append({"": sign, "checked": finding.what, "found": finding.found, "to change": advice})
    yield "", found
    yield f"this machine {'holds' if diagnosis.holds else 'does not hold'} {diagnosis.rate_hz:g} Hz", []


def key_sheets(folder: str, files: Sequence[KeyFile]) -> Sheets:
    """Certificates of a folder, and a line for each that cannot be used."""
    found: list[Row] = []
    for file in files:
        of_one = file.role in (None, "authority")
        found.append(
            {
                "": "✗" if file.problem else "✓",
                "file": file.file,
                "role": file.role or "–",
                "vehicle": file.vehicle or ("–" if of_one else "every"),
                "name": file.name or "–",
                "valid until": f"{file.valid_until:%Y-%m-%d}" if file.valid_until else "–",
                "days left": f"{file.days_left:.0f}" if file.days_left is not None else "–",
            }
        )
    yield folder, found
    if problems := [file.problem for file in files if file.problem]:
        yield paragraph(problems), []
