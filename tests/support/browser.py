"""Chromium for tests of pages; without it they are skipped outside CI."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pytest
from playwright.sync_api import Browser, sync_playwright

PATIENCE_MS: Final = 120_000  # nothing here is about speed; a browser on a busy machine may take its time
_ARGUMENTS: Final = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
                     "--disable-component-update", "--disable-sync"]  # fmt: skip


@contextmanager
def chromium(*arguments: str) -> Iterator[Browser]:
    """A browser, with more arguments."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        assert "CI" not in os.environ, "CI has a Chromium"
        pytest.skip("no Chromium on PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=[*_ARGUMENTS, *arguments], timeout=PATIENCE_MS)
        yield browser
        browser.close()
