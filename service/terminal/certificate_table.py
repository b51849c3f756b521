"""Certificate as text: verdict, bounds, assumptions, the terms that decide, or every term."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from aeroloop.service.terminal.show import Row
from aeroloop.service.theorem.any_law import OwnCertificate
from aeroloop.service.theorem.certificate import Certificate

DECIDING: Final = (
    "‖δ_ε‖", "‖δ_ω‖", "‖δ_u‖", "max ‖θ̃‖", "δ_V1", "c₀/2 − δ_V1", "k", "‖w_s‖", "‖w_f‖", "τ_h of the plant"
)  # fmt: skip
"""Symbols of the terms that are shown unless --verbose: what goes in, what decides, what comes out."""


def certificate_sheets(
    certificate: Certificate | OwnCertificate, verbose: bool = False
) -> Iterator[tuple[str, list[Row]]]:
    """A certificate as tables and paragraphs, with all of its terms if verbose; of a user's law, what it says."""
    if isinstance(certificate, OwnCertificate):
        said = certificate.model_extra or {}
        yield certificate.verdict, [{"": name, "value": str(value)} for name, value in said.items()]
        return
    yield "\n  ".join([certificate.verdict, *certificate.violated[1:]]), []
    yield "", list(_bounds(certificate))
    if certificate.delay_ms is not None:
        late = f"{certificate.delay_ms:.1f} ms of further delay, or {certificate.lost_frames} frames lost in a row"
        yield f"It still holds with {late}.", []
    yield "\n  ".join(["Assumed:", *certificate.assumptions]), []
    yield "", list(_terms(certificate, verbose))
    if not verbose:
        yield f"--verbose prints all {len(certificate.terms)} terms, with their equations.", []


def _bounds(certificate: Certificate) -> Iterator[Row]:
    for what, radius, angle in (
        ("paper's body, at every instant", certificate.pointwise_radius, certificate.pointwise_deg),
        ("configured plant, at every instant", certificate.plant_radius, certificate.plant_deg),
        ("the same with θ̂ as first estimated", certificate.constant_radius, None),
    ):
        shown = "not proven" if radius is None else f"{radius:.4g}"
        yield {"proven, in the end": what, "‖z‖": shown, "attitude": "" if angle is None else f"{angle:.2f}°"}


def _terms(certificate: Certificate, verbose: bool) -> Iterator[Row]:
    for term in certificate.terms:
        if verbose or term.symbol in DECIDING:
            value = "–" if term.value is None else f"{term.value:.4g}"
            meaning = f"{term.meaning} ({term.equation})" if verbose else re.split("[;,]", term.meaning)[0]
            yield {"symbol": term.symbol, "value": value, "unit": term.unit, "meaning": meaning}
