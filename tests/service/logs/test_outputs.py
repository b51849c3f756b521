"""Outputs of the verbs: no log and no input is ever overwritten, another file only with --force."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.logs.outputs import OutputError, check_output, writing
from tests.support.made_log import make_log

VERBS: Final[dict[str, tuple[str, ...]]] = {
    "review --html": ("log", "review", "a.mcap", "--html", "OUT"),
    "compare --html": ("log", "compare", "a.mcap", "b.mcap", "--html", "OUT"),
    "export --format csv": ("log", "export", "a.mcap", "--format", "csv", "--out", "OUT"),
    "export --format mcap": ("log", "export", "a.mcap", "--format", "mcap", "--out", "OUT"),
    "burden --figure": ("lab", "burden", "--figure", "OUT", "--duration", "0.1", "--bits", "6/4", "--quantizer",
                        "uniform"),
}  # fmt: skip
"""Every verb that writes a file that the user names."""


def _link_to_a_log_whose_head_is_lost(path: Path) -> None:
    Path("b.mcap").write_bytes(b"")
    path.symlink_to("b.mcap")


NAMES: Final[dict[str, Callable[[Path], object]]] = {
    "a.mcap": lambda _: None,
    "link.png": lambda path: os.symlink("a.mcap", path),
    "second.png": lambda path: os.link("a.mcap", path),
    "headless.png": _link_to_a_log_whose_head_is_lost,
}
"""Names of a log as an output, and how they come about."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for name in ("a", "b"):
        make_log(folder / f"{name}.mcap", 60)
    return folder


@pytest.fixture
def here(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the logs."""
    for path in logs.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("verb", "out"), [*((verb, "a.mcap") for verb in VERBS), *(("export --format mcap", name) for name in NAMES)]
)
def test_no_verb_overwrites_a_log_by_any_name_and_not_with_force(
    here: Path, verb: str, out: str, capfd: pytest.CaptureFixture[str]
) -> None:
    NAMES[out](Path(out))
    before = contents(here)
    for force in ((), ("--force",)):
        assert execute([out if word == "OUT" else word for word in VERBS[verb]] + [*force]) in (1, 2)
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith("aeroloop: ")
        assert contents(here) == before


@pytest.mark.parametrize("verb", VERBS)
def test_another_file_is_replaced_only_with_force(here: Path, verb: str, capfd: pytest.CaptureFixture[str]) -> None:
    (here / "out.png").write_bytes(b"mine")
    command = ["out.png" if word == "OUT" else word for word in VERBS[verb]]
    assert execute(command) in (1, 2)
    assert "--force" in capfd.readouterr().err
    assert (here / "out.png").read_bytes() == b"mine"
    assert execute([*command, "--force"]) == 0
    assert len((here / "out.png").read_bytes()) > 1000
    assert contents(here).keys() == {"a.mcap", "b.mcap", "out.png"}  # nothing half done stays behind


def test_figures_are_drawn_all_or_none(
    here: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(_: object, folder: Path, name: str) -> list[Path]:  # what is in them is up to tests/service/report
        (folder / f"{name}.png").write_bytes(b"drawn")
        return [folder / f"{name}.png"]

    monkeypatch.setattr("aeroloop.service.report.plots.save", save)
    (here / "C.9-error.png").write_bytes(b"mine")
    before = contents(here)
    assert execute(["log", "review", "a.mcap", "--figures", "."]) == 1
    assert "C.9-error.png" in capfd.readouterr().err
    assert contents(here) == before
    (here / "C.9-error.png").unlink()
    (here / "C.9-error.png").symlink_to("a.mcap")  # a log in a figure's place
    assert execute(["log", "review", "a.mcap", "--figures", ".", "--force"]) == 1
    assert (here / "a.mcap").read_bytes() == before["a.mcap"]
    (here / "C.9-error.png").unlink()
    assert execute(["log", "review", "a.mcap", "--figures", "."]) == 0
    assert len(contents(here)) == 8


def test_what_appears_meanwhile_and_an_input_that_is_no_log_are_not_overwritten_either(here: Path) -> None:
    with pytest.raises(OutputError, match="is a log"), writing(here / "out", force=True):
        (here / "out").write_bytes((here / "a.mcap").read_bytes())
    assert (here / "out").read_bytes() == (here / "a.mcap").read_bytes()
    (here / "a.toml").write_text("vehicle = 'x'\n")
    (here / "link").symlink_to("a.toml")
    with pytest.raises(OutputError, match="input"):
        check_output(here / "link", [None, Path("a.toml")], force=True)
    with pytest.raises(OutputError, match="no regular file"):
        check_output(Path(os.devnull), force=True)
    check_output(here / "new", [Path("none")])
