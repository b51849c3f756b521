"""The house is kept: lint, format, types and who may import whom, in the same command as the tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    "check",
    [
        ("ruff", "check", "."),
        ("ruff", "format", "--check", "."),
        ("mypy",),
        ("mypy", "tests"),
        ("lint-imports", "--no-logo"),
    ],
    ids=" ".join,
)
def test_the_house_is_kept(check: tuple[str, ...]) -> None:
    command = [str(Path(sys.executable).parent / check[0]), *check[1:]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
