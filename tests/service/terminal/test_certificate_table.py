"""Certificate in the terminal: the verdict and what decides it; every term on request; whole at 80 columns."""

from __future__ import annotations

from io import StringIO

import pytest
from rich.cells import cell_len
from rich.console import Console

from aeroloop.service.config import load
from aeroloop.service.terminal import show
from aeroloop.service.terminal.certificate_table import certificate_sheets
from aeroloop.service.theorem.certificate import Certificate, certify


def certificate(*overrides: str) -> Certificate:
    return certify(load(overrides=overrides))


def lines(found: Certificate, monkeypatch: pytest.MonkeyPatch, *, verbose: bool, width: int = 80) -> list[str]:
    screen = Console(width=width, file=StringIO(), force_terminal=True, color_system=None)
    monkeypatch.setattr(show, "Console", lambda: screen)
    show.show_all(certificate_sheets(found, verbose))
    assert isinstance(screen.file, StringIO)
    return screen.file.getvalue().splitlines()


def test_unless_all_is_asked_for_a_verdict_and_about_ten_lines_are_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = certificate()
    shown = lines(found, monkeypatch, verbose=False)
    assert " ".join(" ".join(shown).split()).startswith(found.verdict)
    assert len(shown) <= 45
    assert f"--verbose prints all {len(found.terms)} terms" in shown[-1]


def test_all_terms_are_there_with_their_equations_and_no_word_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    found = certificate()
    shown = lines(found, monkeypatch, verbose=True)
    assert max(map(cell_len, shown)) <= 80
    text = " ".join(" ".join(shown).split())
    for term in found.terms:
        assert any(line.startswith(f"{term.symbol} ") for line in shown), term.symbol
    words = text.split()
    for term in found.terms:
        for word in f"{term.meaning} ({term.equation})".split():
            assert word in words, word
