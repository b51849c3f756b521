"""Outputs of the verbs: no log and no input is ever overwritten, another file only with --force."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.logs.outputs import OutputError, check_output, writing, writing_into
from tests.support.made_log import make_log

VERBS: Final[dict[str, tuple[str, ...]]] = {
    "review --html": ("log", "review", "a.mcap", "--html", "OUT"),
    "compare --html": ("log", "compare", "a.mcap", "b.mcap", "--html", "OUT"),
    "export --format csv": ("log", "export", "a.mcap", "--format", "csv", "--out", "OUT"),
    "export --format mcap": ("log", "export", "a.mcap", "--format", "mcap", "--out", "OUT"),
    "recover": ("log", "recover", "a.mcap", "OUT"),
    "burden --figure": ("lab", "burden", "--figure", "OUT", "--duration", "0.1", "--bits", "6/4"),
}
"""Every verb that writes a file that the user names."""


def _copy(path: Path, name: str) -> str:
    path.with_name(name).write_bytes(path.read_bytes())
    return name


def _link(path: Path, name: str, hard: bool = False) -> str:
    (os.link if hard else os.symlink)(path, path.with_name(name))
    return name


def _emptied(path: Path, name: str) -> str:
    path.with_name("other.mcap").write_bytes(b"")
    return _link(path.with_name("other.mcap"), name)


NAMES: Final[dict[str, Callable[[Path], str]]] = {
    "its own": str,
    "a relative path": lambda path: f"../{path.parent.name}/{path.name}",
    "a symbolic link": lambda path: _link(path, "link.png"),
    "a hard link": lambda path: _link(path, "second.png", hard=True),
    "another ending": lambda path: _copy(path, "renamed.png"),
    "a log whose head is lost": lambda path: _emptied(path, "other.png"),
}
"""Names of a log as an output."""


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
    ("verb", "named"), [*((verb, "its own") for verb in VERBS), *(("recover", name) for name in NAMES)]
)
def test_no_verb_overwrites_a_log_by_any_name_and_not_with_force(
    here: Path, verb: str, named: str, capfd: pytest.CaptureFixture[str]
) -> None:
    out = NAMES[named](here / "a.mcap")
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
        paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
        for path in paths:
            path.write_bytes(b"drawn")
        return paths

    monkeypatch.setattr("aeroloop.service.report.plots.save", save)
    assert execute(["log", "review", "a.mcap", "--figures", "."]) == 0
    drawn = [path for path in here.iterdir() if path.suffix != ".mcap"]
    assert len(drawn) >= 6
    drawn[3].write_bytes(b"mine")
    for path in (*drawn[:3], *drawn[4:]):
        path.unlink()
    before = contents(here)
    assert execute(["log", "review", "a.mcap", "--figures", "."]) == 1
    assert drawn[3].name in capfd.readouterr().err
    assert contents(here) == before
    drawn[3].unlink()
    drawn[3].symlink_to("a.mcap")  # a log in a figure's place
    assert execute(["log", "review", "a.mcap", "--figures", ".", "--force"]) == 1
    assert (here / "a.mcap").read_bytes() == before["a.mcap"]


def test_what_appears_meanwhile_is_not_overwritten(here: Path) -> None:
    def log() -> None:
        with writing(here / "out", force=True) as part:
            part.write_bytes(b"new")
            (here / "out").write_bytes((here / "a.mcap").read_bytes())

    def figure() -> None:
        with writing_into(here / "folder") as folder:
            (folder / "x").write_bytes(b"new")
            (here / "folder" / "x").write_bytes(b"mine")

    with pytest.raises(OutputError, match="is a log"):
        log()
    with pytest.raises(OutputError, match="exists already"):
        figure()
    assert (here / "folder" / "x").read_bytes() == b"mine"
    assert [path.name for path in (here / "folder").iterdir()] == ["x"]


def test_an_input_that_is_no_log_is_not_overwritten_either(here: Path) -> None:
    (here / "a.toml").write_text("vehicle = 'x'\n")
    (here / "link").symlink_to("a.toml")
    with pytest.raises(OutputError, match="input"):
        check_output(here / "link", [None, Path("a.toml")], force=True)
    with pytest.raises(OutputError, match="no regular file"):
        check_output(Path(os.devnull), force=True)
    check_output(here / "new", [Path("none")])


@pytest.mark.usefixtures("here")
def test_what_cannot_be_written_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    for option, out in (("--html", "none/out"), ("--figures", "a.mcap/x")):
        assert execute(["log", "review", "a.mcap", option, out]) == 1
        (line,) = capfd.readouterr().err.splitlines()
        assert out in line
