"""Section on the theorem: what is proven, whether the run kept to it, and each inequality of Lemma 1 at true states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from aeroloop.service.report.page.markup import Html, joined, jump, tag
from aeroloop.service.report.page.tables import Column, table
from aeroloop.service.report.page.verdict import figures_table, run_name
from aeroloop.service.report.rows import THEOREM, figure_rows, percent
from aeroloop.service.review.report import Report, TheoremFindings

COLUMNS: Sequence[Column] = (
    ("Equation", False), ("Left-hand side", False), ("Samples", True), ("Broken", True), ("First at [s]", True),
    ("Closest to its bound [%]", True), ("At [s]", True),
)  # fmt: skip

UNMET: Final = {
    "C.28": "the sensors of attitude err by more than the quantizer, against (C.28)",
    "C.29": "the sensors of the rate err by more than the quantizer, against (C.29)",
    "C.30": "the command is saturated or missing, against (C.30)",
    "Assumption 3": "the attitude error is larger than the certificate assumes",
}
"""Premises that a true state may violate, and what that means."""


def theorem(reports: Sequence[Report]) -> Html:
    """Verdict, figures, inequalities; empty if no run was checked against it."""
    if all(report.findings.theorem is None for report in reports):
        return Html("")
    rows = [row for row in figure_rows([report.findings for report in reports]) if row.key.startswith(THEOREM)]
    verdicts = [_verdict(reports, index) for index, report in enumerate(reports) if report.findings.theorem is not None]
    return joined([*verdicts, figures_table(reports, rows), _lemma(reports)])


def judged(found: TheoremFindings) -> str:
    """How many true states judge the inequalities, in a sentence or two."""
    if not found.samples:
        return ""
    left_out = [f"At {count:,} {UNMET.get(name, name)}." for name, count in found.outside.items() if count]
    by = f"the other {found.judged:,}" if left_out else "all of them"
    return " ".join([f"{found.samples:,} true states belong to a tick.", *left_out, f"Lemma 1 is judged by {by}."])


def _verdict(reports: Sequence[Report], index: int) -> Html:
    found = reports[index].findings.theorem
    assert found is not None
    until = f" Judged until {found.until_s:g} s, where gains or reference changed." if found.until_s is not None else ""
    since = f" Judged from {found.since_s:g} s, when the reference had been reached." if found.since_s else ""
    mood = "good" if found.holds else "bad"
    return tag(
        "div",
        tag("p", run_name(reports[index], index, len(reports))) if len(reports) > 1 else None,
        tag("p", tag("span", "✓" if found.holds else "✗", class_="sign", aria_hidden="true"), " ", found.verdict,
            class_=mood),
        tag("p", *_kept(found), class_="" if found.held is None else "good" if found.held else "bad"),
        tag("p", f"The transient is taken to last {found.transient_s:.3g} s, three times the law's slower "
            f"time constant.{since}{until} {judged(found)}", class_="quiet"),
    )  # fmt: skip


def _kept(found: TheoremFindings) -> tuple[Html, str]:
    """Whether the run kept to all that could be judged."""
    words = {True: ("✓", " The run kept to all of it that could be judged."), None: ("●", " Nothing could be judged.")}
    sign, text = words.get(found.held, ("✗", " The run did not keep to it."))
    return tag("span", sign, class_="sign", aria_hidden="true"), text


def _lemma(reports: Sequence[Report]) -> Html:
    rows = []
    for index, report in enumerate(reports):
        found = report.findings.theorem
        for check in found.lemma if found else ():
            if not check.samples:
                continue
            what = f"({check.equation}) {check.what}"
            first = "–" if check.broken_s is None else jump(check.broken_s, index, f"{what} first broken")
            most = "–" if check.closest is None else percent(check.closest)
            at = "–" if check.closest_s is None else jump(check.closest_s, index, f"{what} closest to its bound")
            broken = tag("b", f"{check.broken:,}", class_="kind grave") if check.broken else "0"
            cells = [f"({check.equation})", check.what, f"{check.samples:,}", broken, first, most, at]
            rows.append((index, cells))
    return table(reports, COLUMNS, rows) if rows else Html("")
