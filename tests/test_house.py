"""Lint, format, types and import rules, in the same command as the tests."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "plant_emulator", "service")


@pytest.fixture(scope="session")
def package_tree() -> Path:
    """A folder in which `aeroloop` is a package of links to the sources.

    An editable installation maps names to folders by an import hook, which mypy and import-linter do not follow. The
    folder is the same each time, because mypy's cache is of paths.
    """
    folder = ROOT / ".tree_cache"
    shutil.rmtree(folder, ignore_errors=True)
    package = folder / "aeroloop"
    package.mkdir(parents=True)
    for source in [*(ROOT / "service/api").iterdir(), *(ROOT / name for name in PACKAGES)]:
        (package / source.name).symlink_to(source)
    return folder


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
def test_the_house_is_kept(check: tuple[str, ...], package_tree: Path) -> None:
    command = [str(Path(sys.executable).parent / check[0]), *check[1:]]
    environment = os.environ | {"PYTHONPATH": str(package_tree), "MYPYPATH": str(package_tree)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_pip_and_uv_install_the_same_versions() -> None:
    uv_pins = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["uv"]["constraint-dependencies"]
    lines = (ROOT / ".ci/constraints.txt").read_text().splitlines()
    pip_pins = [line for line in lines if not line.startswith("#")]
    assert pip_pins == uv_pins


def test_every_folder_of_code_is_in_the_wheel() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    names = {".".join(("aeroloop", *folder.parts)) for folder in folders}
    assert set(listed) == names - {"aeroloop.service.api"} | {"aeroloop"}


BANNED = re.compile(
    r"\b(told|tells?|telling|who|whom|whoever|hears?|heard|hearing|nobody|believes?|thinks?|comes by|gives back|"
    r"at home|looks after)\b",
    re.IGNORECASE,
)
"""Code is not a person: it publishes, receives, reports and computes."""


def test_docstrings_use_the_words_of_the_field() -> None:
    found = []
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                found += [(str(path), each.group()) for each in BANNED.finditer(ast.get_docstring(node) or "")]
    assert found == []


def test_every_room_has_a_readme() -> None:
    rooms = {path.parent for name in PACKAGES for path in (ROOT / name).rglob("__init__.py")}
    small = {"service/api", "service/examples", "service/testing/conformance"}
    lacking = {room.relative_to(ROOT).as_posix() for room in rooms if not (room / "README.md").exists()}
    assert lacking == small
