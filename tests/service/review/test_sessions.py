"""Which session and vehicle a review judges, whose settings it shows, which runs it refuses to mix; comparisons."""

from __future__ import annotations

from collections.abc import Mapping
from json import loads
from pathlib import Path
from typing import Any

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load
from aeroloop.service.logs.mcap_file import RECORDER_METADATA
from aeroloop.service.logs.recording import Recording, ReviewError
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import compared, read, read_runs, review
from tests.support.edited_log import message_of, rewrite
from tests.support.made_log import START_NS, VEHICLE, Logged, description, made, make_log, write

HOUR_NS = 3_600_000_000_000
OTHER = "beta"


def of_vehicle(messages: list[Logged], vehicle: str) -> list[Logged]:
    return [one._replace(key=one.key.replace(f"/{VEHICLE}/", f"/{vehicle}/")) for one in messages]


def described(settings: Settings, role: str, vehicle: str = VEHICLE, at_ns: int = 0) -> Logged:
    text = description(settings, role).model_copy(update={"vehicle": vehicle}).model_dump_json()
    return Logged(START_NS + at_ns, topics.key("description", vehicle, role=role), text.encode(), START_NS + at_ns)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions of a vehicle, whose controller was restarted with other gains, and one of another vehicle."""
    first, second, other = load(), load(overrides=["law.C2=[0.3, 0.3, 0.3]"]), load(overrides=["plant.aero.mass=1.3"])
    messages = [
        *(described(first, role) for role in ("controller", "plant")),
        *(described(other, role, OTHER) for role in ("controller", "plant")),
        *made(first, 200),
        *of_vehicle(made(other, 150, session="b1", at_ns=HOUR_NS), OTHER),
        described(second, "controller", at_ns=2 * HOUR_NS),
        *made(second, 100, session="s2", at_ns=2 * HOUR_NS),
    ]
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    write(path.with_name("plain"), first, messages, roles=())
    trips = [
        message_of(
            "event", Event(role="plant", kind="tripped", text=f"trip of {session}", session=session, tick=50), at
        )
        for session, at in (("s1", START_NS + 10**8), ("s2", START_NS + 2 * HOUR_NS + 10**8))
    ]
    trips.append(trips[0]._replace(key=topics.key("event", OTHER, role="plant")))
    rewrite(path.with_name("plain"), path, more=trips)
    path.with_name("plain").unlink()
    return path


def test_the_longest_session_is_judged_unless_one_is_named_or_numbered(log: Path) -> None:
    def which(**chosen: Any) -> tuple[str, str]:
        found = read(log, **chosen).findings
        return found.vehicle, found.session

    assert which() == which(session="1") == which(session="s1") == (VEHICLE, "s1")
    assert which(session="2") == which(session="aero/s2") == which(session="s2", vehicle=VEHICLE) == (VEHICLE, "s2")
    assert which(vehicle=OTHER) == which(session="1", vehicle=OTHER) == which(session="b1") == (OTHER, "b1")
    for session, vehicle in (("3", None), ("0", None), (None, "x"), ("s1", OTHER)):
        with pytest.raises(ReviewError):
            read(log, session=session, vehicle=vehicle)


def test_a_session_is_judged_by_the_configuration_that_it_began_with(log: Path, tmp_path: Path) -> None:
    """And as if it stood alone; else its gains would be those of the controller that came later."""
    alone = {"1": load(), "2": load(overrides=["law.C2=[0.3, 0.3, 0.3]"])}
    for number, settings in alone.items():
        found = read(log, session=number)
        assert found.settings.law == settings.law
        messages = made(settings, 200 if number == "1" else 100)
        assert found.figures.z_track == review(write(tmp_path / "a.mcap", settings, messages)).z_track
    replayed = replay([log])
    assert [(one.session, one.differ) for one in replayed.sessions] == [("s1", 0), ("s2", 0)]
    assert replayed.others == [f"{OTHER}/b1, 300 rows"]
    other = replay([log], vehicle=OTHER)
    assert [(one.session, one.differ) for one in other.sessions] == [("b1", 0)]


def test_trips_are_of_the_vehicle_and_of_a_named_session_alone_and_the_account_lists_all_of_both(
    log: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert read(log).findings.trips == ["trip of s1", "trip of s2"]
    assert read(log, session="2").findings.trips == ["trip of s2"]
    assert read(log, vehicle=OTHER).findings.trips == ["trip of s1"]
    assert [mark.time_s for mark in read(log, session="2").findings.marks if mark.kind == "tripped"] == [None, 0.1]
    assert execute(["log", "review", str(log), "--session", "2"]) == 0
    out = " ".join(capfd.readouterr().out.split())
    assert "vehicles aero, beta; shown is aero, --vehicle shows another" in out
    assert "sessions 1 is s1, 0.4 s; 2 is s2, 0.2 s; --session N shows another" in out


def recorded(path: Path, messages: list[Logged], identity: str | None) -> Path:
    settings = load()
    write(path.with_suffix(".plain"), settings, messages)
    entry = {"json": f'{{"run": "a", "part": "a", "id": "{identity}"}}'}
    out = rewrite(path.with_suffix(".plain"), path, metadata=[(RECORDER_METADATA, entry)] if identity else [])
    path.with_suffix(".plain").unlink()
    return out


@pytest.mark.parametrize("identities", [("x", "y"), (None, None), ("x", None)])
def test_unrelated_runs_are_refused_by_every_reader(
    tmp_path: Path, identities: tuple[str | None, str | None], capfd: pytest.CaptureFixture[str]
) -> None:
    a = recorded(tmp_path / "a.mcap", made(load(), 200), identities[0])
    b = recorded(tmp_path / "b.mcap", made(load(), 100, session="s2", at_ns=HOUR_NS), identities[1])
    for command in (("review",), ("replay",), ("export", "--format", "csv"), ("export", "--format", "mcap")):
        for logs in ([str(a), str(b)], [str(tmp_path)]):
            assert execute(["log", *command, *logs]) == 1
            (line,) = capfd.readouterr().err.splitlines()
            assert f"2 unrelated runs ({a}; {b})" in line
            assert "log compare" in line
    assert execute(["log", "compare", str(a), str(b)]) == 0


def test_what_a_restarted_recorder_wrote_is_one_run(tmp_path: Path) -> None:
    """The loop went on meanwhile: its processes are the same. So is a recorder's run, even if the loop is another."""
    messages = made(load(), 400)
    parts = [recorded(tmp_path / f"{i}.mcap", messages[i::2], f"id{i}") for i in range(2)]
    assert review(*parts).z_track == review(recorded(tmp_path / "whole", messages, None)).z_track
    later = recorded(tmp_path / "later.mcap", made(load(), 100, session="s2", at_ns=HOUR_NS), "id1")
    assert len(Recording([later, *parts]).extents) == 2


def test_settings_are_those_of_the_role_that_owns_them_and_disagreements_are_findings(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    controller = load()
    plant = load(overrides=["plant.aero.mass=2.0", 'plant.faults=["rate:off@5"]', "law.C2=[9, 9, 9]", "loop.cpus=[0]"])
    recorder = load(overrides=["recorder.max_file_mb=50"])
    its: Mapping[str, Settings] = {"plant": plant, "recorder": recorder}
    roles = ("controller", "plant", "recorder")
    path = write(tmp_path / "a.mcap", controller, made(controller, 100), roles=roles, its=its)
    shown = read(path).report()
    assert shown.settings["plant"] == plant.description()["plant"]
    assert shown.settings["recorder"]["max_file_mb"] == 50
    assert shown.settings["law"] == controller.description()["law"]
    differ = [(one.key, one.controller, one.plant) for one in shown.findings.disagreements]
    assert differ == [("plant.aero.mass", controller.plant.aero.mass, 2.0)]
    assert execute(["log", "review", str(path)]) == 0
    out = " ".join(capfd.readouterr().out.split())
    assert f"ends disagree plant.aero.mass: controller {controller.plant.aero.mass}, plant 2.0" in out


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two runs that differ in a gain, and in where their logs are."""
    folder = tmp_path_factory.mktemp("logs")
    for name, gain in (("calm", "0.15"), ("keen", "0.3")):
        mine = [f"recorder.path={name}", f"network.rendezvous=tcp/127.0.0.1:{len(name)}"]
        settings = load(overrides=["loop.lockstep=true", f"law.C2=[{gain}, {gain}, {gain}]", *mine])
        make_log(folder / f"{name}.mcap", 100, settings=settings)
    return str(folder / "calm.mcap"), str(folder / "keen.mcap")


def test_logs_are_compared_in_the_terminal_as_json_and_on_a_page(
    logs: tuple[str, str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    assert execute(("log", "compare", *logs, "--html", str(out))) == 0
    printed = capfd.readouterr().out
    assert "law.C2" in printed
    assert "[0.3, 0.3, 0.3]" in printed
    assert "2 runs compared" in out.read_text()
    assert list(tmp_path.iterdir()) == [out]
    assert execute(("log", "compare", *logs, "--json")) == 0
    compared = loads(capfd.readouterr().out)
    values = {"calm": [0.15] * 3, "keen": [0.3] * 3}
    assert compared["differences"] == [{"key": "law.C2", "values": values}]
    assert compared["runs"]["calm"]["z_track"] != compared["runs"]["keen"]["z_track"]


def test_a_limit_holds_only_if_it_holds_for_every_run(logs: tuple[str, str], capfd: pytest.CaptureFixture[str]) -> None:
    assert execute(("log", "compare", *logs, "--require", "duration_s=0.2")) == 0
    assert execute(("log", "compare", *logs, "--require", "duration_s=0.1")) == 1
    assert capfd.readouterr().err.splitlines()[-1].count("duration_s ≤ 0.1") == 2
    assert execute(("log", "compare", logs[0])) == 2
    assert capfd.readouterr().err == "aeroloop: log compare takes two logs or more\n"


def test_logs_of_one_name_are_named_with_their_folders_or_by_number(logs: tuple[str, str], tmp_path: Path) -> None:
    for folder, log in zip(("before", "after"), logs, strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "log.mcap").write_bytes(Path(log).read_bytes())
    named = read_runs([tmp_path / "before/log.mcap", tmp_path / "after/log.mcap", tmp_path / "after/log.mcap"])
    assert [run.name for run in named] == ["before/log", "after/log", "after/log (2)"]
    assert list(compared(named)["runs"]) == [run.name for run in named]
