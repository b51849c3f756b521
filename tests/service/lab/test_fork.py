"""A fork repeats what was recorded where nothing is changed, byte for byte, and else does what the change says."""

from __future__ import annotations

import importlib
import json
import runpy
import shutil
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import aeroloop
from aeroloop.protocol.errors import AeroloopError, ConfigError
from aeroloop.protocol.messages.trace import read_batch
from aeroloop.service import examples
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load, load_over
from aeroloop.service.lab.check import check_log, check_logs, logs_of
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.fork import REPLAYED, ForkError, fork
from aeroloop.service.logs.recording import Recording, ReviewError
from aeroloop.service.logs.replay import replay
from aeroloop.service.logs.session import Session
from aeroloop.service.logs.ticks import euler_deg, without
from aeroloop.service.review.review import read
from tests.golden.make import HERE as GOLDEN
from tests.support import own_laws, own_plants
from tests.support.edited_log import Said, contents, edited, rewrite
from tests.support.in_this_process import run_here
from tests.support.made_log import (
    AN_OPERATORS_WORDS,
    lockstep,
    made,
    make_log,
    make_log_with_faults_of_frames,
    write,
)

TICKS = 450
LONGER = 1700
LOST = 24  # of the batches of 51 ticks: one that is between two records of what is in force
NO_RECORD = 31  # so many first batches have all records
PLANT = ["session_tick", "sent_as", "received_as", "outcome", "answered", "measurement", "command"]
TAIL_BYTES = slice(12, 16)  # where a batch's header has the length of its tail
CONTROLLER = ["tick", "received_as", "sent_as", "measurement", "command"]


def session(log: Path) -> Session:
    recording = Recording([log])
    return recording.session(recording.choose())


def assert_repeats(log: Path, out: Path, tick: int) -> None:
    """All that the rows of both ends have but times, from a tick on."""
    recorded, forked = session(log), session(out)
    for end, name, columns in (("plant", "session_tick", PLANT), ("controller", "tick", CONTROLLER)):
        rows, again = getattr(recorded, end), getattr(forked, end)
        assert rows[rows[name] >= tick][columns].tolist() == again[columns].tolist()
        assert len(again)


@pytest.mark.parametrize(  # gains change at 2000, a fault acts from 2499 on, an operator stops at 4499
    ("name", "tick"), [("default", 0), ("default", 1999), ("default", 2600), ("on-change", 1), ("on-change", 700)]
)
def test_a_fork_with_no_change_repeats_the_rest_of_a_lockstep_log(tmp_path: Path, name: str, tick: int) -> None:
    log, out = GOLDEN / f"{name}.mcap", tmp_path / "fork.mcap"
    found = fork([log], tick, log=out)
    assert (found.parts, found.differed) == (None, None)
    assert_repeats(log, out, tick)
    assert found.figures.z_track == found.recorded.figures.z_track
    assert (found.figures.log, found.forked.findings.log) == (str(out), str(out))
    again = replay([out])
    assert (again.differs, again.complete) == (False, True)
    assert again.reasons == {
        "plant": f"a fork's plant begins in flight, at tick {tick}: only the log that was forked has its state"
    }
    assert not read(out).findings.missing


def test_a_fork_is_read_from_the_middle_with_the_state_that_its_law_had_there(tmp_path: Path) -> None:
    log, out, damaged = GOLDEN / "default.mcap", tmp_path / "fork.mcap", tmp_path / "damaged.mcap"
    whole = fork([log], 1000, duration_s=4, log=out).ticks
    part = read(out, since_s=4).ticks
    assert part.k[0] == 2000
    last = whole.where(whole.k >= 2000)
    assert np.array_equal(part.state, last.state)
    assert np.array_equal(part.unquantized, last.unquantized)
    assert np.abs(last.state[0, :3] - whole.state[0, :3]).max() > 1e-5  # the estimate has changed

    batches = [one for one in contents(out)[0] if one.topic == "trace" and one.key.endswith("controller")]
    lost = batches[10]
    rewrite(out, damaged, lambda one: None if one == lost else one)
    again = replay([damaged], ends=["controller"])
    assert (again.differs, again.unknown) == (False, [])


def without_states(one: Said) -> Said:
    """A controller's batch without the law's state, but for the session's first."""
    batch = read_batch(one.data) if one.topic == "trace" else None
    if batch is None or batch.header.end != "controller" or not batch.header.first_row:
        return one
    begin = len(one.data) - batch.header.tail_bytes
    tail = batch.tail.model_copy(update={"state": None}).model_dump_json(exclude_none=True).encode()
    header = bytearray(one.data[:begin])
    header[TAIL_BYTES] = len(tail).to_bytes(4, "little")
    return one._replace(data=bytes(header) + tail)


def test_a_state_that_a_log_lacks_is_computed_from_the_last_one_or_unknown_and_never_the_initial_one(
    tmp_path: Path,
) -> None:
    """As the first forks' logs: they have the law's state in their first batch only."""
    make_log(log := tmp_path / "run.mcap", LONGER)
    old = rewrite(log, tmp_path / "old.mcap", without_states)
    part, expected = read(old, since_s=0.5).ticks, read(log, since_s=0.5).ticks
    assert np.array_equal(part.state, expected.state)
    assert np.array_equal(part.unquantized, expected.unquantized)

    batches = [one for one in contents(old)[0] if one.topic == "trace" and one.key.endswith("controller")]
    damaged = rewrite(old, tmp_path / "damaged.mcap", lambda one: None if one == batches[LOST] else one)
    again = replay([damaged], ends=["controller"])
    lost = read_batch(batches[LOST].data)
    assert lost is not None
    assert not again.differs
    (unknown,) = again.unknown
    assert unknown.first_tick == lost.columns["tick"][-1] + 1
    assert unknown.last_tick == LONGER - 1
    assert not again.complete
    assert read(damaged).ticks.k[-1] < unknown.first_tick


@pytest.mark.parametrize(
    "faults",
    [
        ["measurement:delay=0.02@0.1..0.7"],
        ["measurement:delay=0.6@0.1..0.85"],  # longer than the counter's range
        ["measurement:reorder=0.3", "measurement:duplicate=0.3"],
        ["command:delay=0.02", "measurement:drop=0.2"],
    ],
)
@pytest.mark.parametrize("transmit", ["periodic", "on_change"])
def test_a_fork_goes_on_with_the_frames_that_are_in_flight(tmp_path: Path, faults: list[str], transmit: str) -> None:
    log, out = tmp_path / "run.mcap", tmp_path / "fork.mcap"
    patient = ["plant.watchdog_s=2", "controller.stale_s=2", f'wire.transmit="{transmit}"']
    make_log_with_faults_of_frames(log, TICKS, lockstep(*patient, f"plant.faults={json.dumps(faults)}"))
    recorded = session(log)
    rows = recorded.controller
    for tick in (52, 60, 200, 352, 440):
        out.unlink(missing_ok=True)
        found = fork([log], tick, log=out)
        assert (found.parts, found.differed, found.ended) == (None, None, None)
        assert found.compared > 0
        forked = session(out)
        plant = recorded.plant[recorded.plant["session_tick"] >= tick]
        assert plant[PLANT].tolist()[: len(forked.plant)] == forked.plant[PLANT].tolist()
        again = forked.controller
        assert rows[rows["tick"] >= again["tick"][0]][CONTROLLER].tolist()[: len(again)] == again[CONTROLLER].tolist()
        assert (replay([out]).differs, replay([out]).complete) == (False, True)


def test_a_fork_and_the_recorded_run_are_judged_over_the_same_span(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", TICKS)
    dead = fork([log], 200, faults=["rate:off"])
    assert dead.ended is not None
    assert dead.figures.duration_s == 0.002  # without a rate no measurement is valid
    assert dead.recorded.figures.duration_s == dead.figures.duration_s
    assert dead.recorded.ticks.k.tolist() == dead.ticks.k.tolist()


def test_a_session_that_is_read_is_the_one_that_is_forked(tmp_path: Path) -> None:
    settings = lockstep()
    second = [
        message._replace(key=message.key.replace("s1", "s2"))
        for message in made(settings, 100, session="s2", at_ns=60_000_000_000)
    ]
    log = write(tmp_path / "two.mcap", settings, [*made(settings, 300), *second])
    run = aeroloop.read_run(log, session="s2")
    assert (run.session, run.ticks.k[-1]) == ("s2", 99)
    assert run.fork(50).recorded.findings.session == "s2"


def test_what_an_operator_did_just_after_the_forks_tick_acts(tmp_path: Path) -> None:
    make_log(faulty := tmp_path / "faulty.mcap", TICKS, injected={201: "rate.y:bias=0.5"})
    out = tmp_path / "fork.mcap"
    assert fork([faulty], 200, log=out).parts is None  # it was injected after tick 200
    assert_repeats(faulty, out, 200)
    assert fork([faulty], 201).parts is None  # and not twice


def test_a_fork_resumes_after_a_gap_and_refuses_a_tick_whose_state_the_log_lacks(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", LONGER)
    batches = [one for one in contents(log)[0] if one.topic == "trace" and one.key.endswith("controller")]
    lost = read_batch(batches[LOST].data)
    assert lost is not None
    first, last = int(lost.columns["tick"][0]), int(lost.columns["tick"][-1])
    damaged = rewrite(log, tmp_path / "damaged.mcap", lambda one: None if one == batches[LOST] else one)
    resumed, recorded = fork([damaged], last + 1), read(log).ticks
    assert resumed.parts is None
    assert np.array_equal(resumed.ticks.state[0], recorded.state[recorded.k == last + 1][0])
    for tick in (first + 1, last):
        with pytest.raises(ForkError, match=f"tick {tick} cannot be forked: "):
            fork([damaged], tick)

    first_ones = batches[:NO_RECORD]
    nothing_known = rewrite(log, tmp_path / "unknown.mcap", lambda one: None if one in first_ones else one)
    with pytest.raises(ForkError, match="cannot be forked"):
        fork([nothing_known], 0)


@pytest.mark.parametrize(
    "overrides",
    [
        [f"law.kind={own_laws.__name__}:Python"],
        [f"plant.kind={own_plants.__name__}:Pair"],
        ["plant.wind.blowing=true", "plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01"],
        ["plant.kind=mujoco", 'plant.own.model="aero"'],
    ],
)
def test_a_fork_repeats_any_law_and_any_plant_that_repeats(tmp_path: Path, overrides: list[str]) -> None:
    log, out = tmp_path / "run.mcap", tmp_path / "fork.mcap"
    make_log(log, TICKS, settings=lockstep(*overrides))
    assert fork([log], 251, log=out).parts is None
    assert_repeats(log, out, 251)


def test_a_real_time_log_is_repeated_up_to_the_tick_that_the_network_decided(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", TICKS, settings=load(), lost={300})
    found = fork([log], 100)
    assert found.parts is not None
    assert (found.parts.tick, found.parts.end, found.parts.logged) == (300, "controller", "missing")
    assert found.network == 301
    assert fork([log], 301).parts is None


def test_gains_and_a_reference_changed_by_a_fork_are_those_changed_by_an_operator(tmp_path: Path) -> None:
    without, changed = tmp_path / "without.mcap", tmp_path / "changed.mcap"
    make_log(without, TICKS)
    make_log(changed, TICKS, changes={tick: AN_OPERATORS_WORDS[tick] for tick in (120,)})
    found = fork([without], 120, overrides=["law.C2=[0.2,0.2,0.2]"], log=tmp_path / "a.mcap")
    assert_repeats(changed, tmp_path / "a.mcap", 120)
    assert found.parts is not None
    fork([changed], 100, overrides=["law.C2=[0.15,0.15,0.15]"], log=tmp_path / "b.mcap")  # what comes at 120 does not
    assert_repeats(without, tmp_path / "b.mcap", 100)

    held = fork([without], 200, overrides=["reference.kind=hold", "reference.attitude=[0,5,-10]"], duration_s=8)
    assert held.figures.duration_s == 8
    assert euler_deg(held.ticks.attitude[-1:])[0].tolist() == pytest.approx([0, 5, -10], abs=1.5)
    steps = np.diff(euler_deg(held.ticks.desired), axis=0)
    assert np.abs(steps).max() < 0.12  # it is approached without a jump, at 1 rad/s at the most


def test_a_fault_injected_by_a_fork_is_that_injected_by_an_operator(tmp_path: Path) -> None:
    without, faulty, fault = tmp_path / "without.mcap", tmp_path / "faulty.mcap", "command:drop=0.3@0..0.4"
    make_log(without, TICKS)
    make_log(faulty, TICKS, injected={201: fault})
    found = fork([without], 200, faults=[fault], log=tmp_path / "fork.mcap")
    assert found.parts is not None
    assert_repeats(faulty, tmp_path / "fork.mcap", 200)
    dead = fork([without], 200, faults=["rate:off"])
    assert dead.ended == "the sensors have had no valid value for 102 ms: 0 V"
    assert dead.figures.trips == [dead.ended]


@pytest.mark.parametrize(
    "override", ["law.C1=[0.5,0.5,0.5]", "plant.aero.mass=1.3", "wire.attitude.bits=10", "law.kind=lqr"]
)
def test_a_fork_at_the_start_is_an_experiment_with_the_change(tmp_path: Path, override: str) -> None:
    make_log(log := tmp_path / "run.mcap", TICKS)
    expected = run_experiment(load_over(lockstep(), [override]), TICKS * 0.002)
    found = fork([log], 0, overrides=[override]).figures
    assert (found.z_track, found.u_total) == (expected.z_track, expected.u_total)


def test_a_body_changed_in_flight_goes_on_from_the_state_that_it_had(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", TICKS, settings=lockstep("plant.wind.blowing=true"))
    calm = fork([log], 300, overrides=["plant.wind.blowing=false"], log=tmp_path / "fork.mcap")
    assert calm.parts is not None
    assert 300 < calm.parts.tick < 400  # the first measurements are the same
    heavier = fork([log], 300, overrides=["plant.aero.mass=2.5"])
    assert calm.parts != heavier.parts
    assert np.array_equal(calm.ticks.attitude[0], heavier.ticks.attitude[0])
    settings = load().plant
    plants = [settings.build(0.002) for _ in range(2)]
    for plant in plants:
        for _ in range(100):
            plant.actuate((10.0, 8.0))
            plant.advance()
    plants[1] = settings.continued(plants[1], settings, 0.002)
    for plant in plants:
        plant.advance()
    assert plants[0].truth() == plants[1].truth()
    assert plants[0].measure() == plants[1].measure()


def test_an_interrupted_fork_leaves_no_log(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", TICKS)

    def interrupt(share: float) -> None:
        if share > REPLAYED:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fork([log], 50, log=tmp_path / "fork.mcap", progress=interrupt)
    assert list(tmp_path.iterdir()) == [log]


def test_what_cannot_be_forked_is_refused_in_one_line(tmp_path: Path) -> None:
    make_log(log := tmp_path / "run.mcap", 100)
    make_log(wheels := tmp_path / "wheels.mcap", 100, settings=lockstep(f"plant.kind={own_plants.__name__}:Pair"))
    at_50 = partial(fork, [log], 50)
    for refused, line in (
        (partial(at_50, overrides=["wire.attitude.bits=10"]), "wire.* holds from the session's start: fork it --at 0"),
        (partial(at_50, overrides=["plant.limits.max_rate=9"]), "plant.limits holds from a session's start"),
        (
            partial(at_50, overrides=["plant.rotor.lag_up_s=0", "plant.rotor.lag_down_s=0"]),
            "or rotors where there were",
        ),
        (partial(fork, [wheels], 50, overrides=["plant.own.inertia=2"]), "plant.own holds from a session's start"),
        (partial(fork, [log], 100), "the session has ticks 0 to 99, up to 0.198 s, and none 100"),
        (partial(at_50, overrides=["law.C9=1"]), "unknown key law.C9"),
        (partial(at_50, faults=["foo"]), "it is written signal:kind"),
        (partial(at_50, log=log), "is an input of this command; name another file"),
        (partial(fork, [GOLDEN / "can.mcap"], 50), "only an emulated plant is computed again"),
    ):
        with pytest.raises(AeroloopError) as error:
            refused()
        assert line in str(error.value)
        assert "\n" not in str(error.value)


# ── `log check`: a change is judged by logs; what differs is named, what is accepted is expected from then on ──


MORE_DAMPING = "law.C2=[0.2,0.2,0.2]"


@pytest.fixture(autouse=True)
def _no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a user runs it, on all cores: tests/golden."""
    run_here(monkeypatch)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    make_log(folder / "a.mcap", TICKS, settings=lockstep())
    make_log(folder / "b.mcap", TICKS, settings=load())
    return folder


def test_logs_of_this_code_are_equal_and_their_loops_run_again(corpus: Path) -> None:
    first, second = check_logs([corpus])
    for one in (first, second):
        assert (one.same, one.commands, one.differ, one.plant_ticks, one.plant_differ) == (True, TICKS, 0, TICKS, 0)
        assert (one.first, one.notes, one.error) == ([], [], None)
        assert one.before is not None
        assert one.after is not None
        assert one.before.z_track == one.after.z_track  # made without a lost or late frame


def test_a_change_is_named_by_its_first_tick_its_signal_both_values_and_steps(corpus: Path) -> None:
    one = check_log([corpus / "a.mcap"], [MORE_DAMPING])
    assert not one.same
    assert 0 < one.differ < TICKS
    assert one.first == ["s1 at tick 0 (0 s), logged and computed: voltage_2 3.80952 and 4.57143 V, 1 step apart"]
    assert one.before is not None
    assert one.after is not None
    assert one.after.z_track != one.before.z_track
    other = check_log([corpus / "a.mcap"], ["wire.attitude.bits=10"])
    assert not other.same
    assert other.first == ["its measurements are frames of another wire, so no command can be computed from them"]
    assert other.after is not None
    assert other.after.z_track != one.before.z_track
    heavier = check_log([corpus / "a.mcap"], ["plant.aero.mass=1.3"])  # on the recorded measurements all is the same
    assert heavier.same
    assert heavier.after is not None
    assert heavier.after.z_track != one.before.z_track


def test_what_is_accepted_is_expected_and_anything_else_is_not(tmp_path: Path) -> None:
    make_log(log := tmp_path / "a.mcap", TICKS)
    words = ["log", "check", str(log), "--json", "--set"]
    assert execute([*words, MORE_DAMPING]) == 1
    assert execute([*words, MORE_DAMPING, "--accept"]) == 0
    assert json.loads((tmp_path / "a.accepted.json").read_text())["differ"] > 0
    assert execute([*words, MORE_DAMPING]) == 0
    assert execute([*words, "law.C2=[0.21,0.21,0.21]"]) == 1
    assert execute(words[:-1]) == 0  # equal needs no acceptance
    (tmp_path / "a.accepted.json").write_text("{}")
    assert execute([*words, MORE_DAMPING]) == 1


OWN_LAW = """
from tests.support import own_laws


class Settings(own_laws.PDSettings):
    pass


class Mine(own_laws.Expressions):
    Settings = Settings
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, Path]]:
    """A log of a law in a file of the user's own, and the file."""
    file = tmp_path / "a_law_of_mine.py"
    file.write_text(OWN_LAW)
    monkeypatch.syspath_prepend(tmp_path)
    make_log(log := tmp_path / "a.mcap", 200, settings=lockstep(f"law.kind={file.stem}:Mine"))
    yield log, file
    sys.modules.pop(file.stem, None)


def rewrite_module(file: Path, text: str) -> None:
    """Change a module's source as an editor does between two runs of Python."""
    file.write_text(text)
    shutil.rmtree(file.parent / "__pycache__", ignore_errors=True)
    sys.modules.pop(file.stem, None)
    importlib.invalidate_caches()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("class Mine(", "class Yours(", "has no Mine"),
        ("    Settings = Settings", '    Settings = Settings\n    gains = ("kp", "gone")', "gone"),
        ("class Mine(", "import gone\n\nclass Mine(", "gone"),
        ("class Mine(", "class Mine((", "SyntaxError"),
    ],
    ids=["class renamed", "gain renamed", "bad import", "syntax error"],
)
def test_a_law_that_cannot_be_computed_is_no_equal_law(
    own: tuple[Path, Path], capsys: pytest.CaptureFixture[str], old: str, new: str, says: str
) -> None:
    """Of the log and in the shipped example of a test, which passes with the law as it was."""
    log, file = own
    example = runpy.run_path(str(Path(examples.__path__[0]) / "test_logs.py"))
    judges = example["test_a_log_gives_the_same_commands_and_its_loop_tracks_no_worse"]
    judges(log)
    rewrite_module(file, OWN_LAW.replace(old, new))
    with pytest.raises(AssertionError, match=says):
        judges(log)
    capsys.readouterr()
    assert execute(["log", "check", str(log), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["same"] is False
    assert says in printed["logs"][0]["error"]
    assert execute(["log", "check", str(log), "--accept"]) == 1
    assert not log.with_name("a.accepted.json").exists()


@pytest.mark.parametrize(("first", "last"), [(100, 200), (0, TICKS)], ids=["some rows", "the controller's trace"])
def test_a_log_that_lacks_rows_is_not_equal_and_says_which(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], first: int, last: int
) -> None:
    def lacking(one: Said) -> Said | None:
        batch = read_batch(one.data) if one.key.endswith("trace/controller") else None
        if batch is None:
            return one
        ticks = batch.columns["tick"]
        is_lost = last == TICKS or (len(ticks) > 0 and first <= ticks[0] < last)
        return None if is_lost else one

    log = rewrite(corpus / "a.mcap", tmp_path / "a.mcap", lacking)
    (found,) = check_logs([log], accept=True)
    assert not found.same
    assert (found.first, found.error) == ([], None)
    assert any("of the controller's ticks in s1, ticks " in line for line in found.unseen)
    assert execute(["log", "check", str(log)]) == 1
    assert "a.mcap: not compared: " in " ".join(capsys.readouterr().out.split())


def test_only_the_gains_that_are_overridden_replace_an_operators(tmp_path: Path) -> None:
    """An override with the value of the log changes nothing; one gain leaves an operator's others as they are."""
    settings = lockstep()
    make_log(log := tmp_path / "a.mcap", 1000, settings=settings, changes=AN_OPERATORS_WORDS)
    assert settings.law.kind == "adaptive"
    inertia = settings.description()["law"]["inertia"]
    for same in (f"law.inertia={json.dumps(inertia)}", "law.kind=adaptive"):
        found = check_log([log], [same])
        assert (found.same, found.differ) == (True, 0), same
    gamma = check_log([log], ["law.Gamma=[0.03,0.03,0.03]"])
    assert gamma.first[0].startswith("s1 at tick ")
    assert replay([log], ["law.Gamma=[0.02,0.02,0.02]"]).sessions[0].first_difference is not None
    recording = Recording([log])
    its = recording.session(recording.choose())
    changed = without(its.changes[-1], ["law.Gamma", "reference.kind"])
    assert (changed.gains, changed.reference) == (None, None)
    kept = without(its.changes[1], ["law.Gamma"])
    assert kept.gains is not None
    assert kept.gains.named == {"C2": (0.2, 0.2, 0.2)}
    forked = fork([log], 0, overrides=["law.Gamma=[0.02,0.02,0.02]"])  # the operator's C2 acts as it did
    assert forked.parts is not None
    assert forked.parts.tick >= 400


def test_accepted_differences_do_not_cover_later_ones(tmp_path: Path) -> None:
    """Two rows of the controller, in the first batch and far behind it, that are not what it computes."""
    make_log(log := tmp_path / "a.mcap", TICKS, settings=lockstep())

    def other(*ticks: int) -> Path:
        def edit(columns: dict[str, np.ndarray]) -> None:
            frames = columns["command"].view(np.uint8).reshape(len(columns["tick"]), -1)
            frames[np.isin(columns["tick"], ticks), -1] ^= 0x10

        return rewrite(log, tmp_path / "b.mcap", edited("controller", edit))

    first = check_log([other(7)], [])
    assert (first.differ, first.same) == (1, False)
    (accepted,) = check_logs([tmp_path / "b.mcap"], accept=True)
    assert accepted.same
    assert check_log([other(7)], []).same
    for later in (300, 449):
        both = check_log([other(7, later)], [])
        assert (both.differ, both.first) == (2, first.first)
        assert not both.same


LATE = """
    def expressions(self, now):
        u, after = super().expressions(now)
        is_first = now.state["sign"] == 0
        return 0 * u + 24 * is_first - {volts} * (1 - is_first), after
"""


def test_other_commands_later_are_not_accepted_with_the_first(own: tuple[Path, Path]) -> None:
    """Two changes that differ from the log at every tick, at the first by the same command."""
    log, file = own
    found = []
    for volts in (24, 20):
        rewrite_module(
            file, OWN_LAW.replace("    Settings = Settings\n", "    Settings = Settings\n" + LATE.format(volts=volts))
        )
        found.append(check_logs([log], accept=volts == 24)[0])
    accepted, other = found
    assert accepted.same
    assert (other.first, other.differ) == (accepted.first, accepted.differ)
    assert not other.same


def test_the_table_goes_into_a_pull_request(corpus: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "table.md"
    assert execute(["log", "check", str(corpus), "--law", "pid", "--markdown", str(out)]) == 1
    head, _, *found = out.read_text().split("\n\n")[0].splitlines()
    assert head.startswith("|  | log | commands | plant | first difference | z_track ×10⁻⁴ s | u_total V²·s | max")
    assert [row.split(" | ")[:2] for row in found] == [["| ✗", "a.mcap"], ["| ✗", "b.mcap"]]
    assert "✗  a.mcap" in capfd.readouterr().out


def test_a_log_that_cannot_be_read_is_a_row_and_a_wrong_override_is_an_error(corpus: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_text("hello")
    (tmp_path / "empty").mkdir()
    for overrides in ([], [MORE_DAMPING]):
        (one,) = check_logs([tmp_path], overrides)
        assert not one.same
        assert one.error is not None
        assert "broken.mcap does not begin as an MCAP file" in one.error
    with pytest.raises(ConfigError, match=r"unknown key law.C9"):
        check_logs([corpus], {"law.C9": 1})
    with pytest.raises(ReviewError, match=r"there is no \.mcap file in"):
        check_logs([tmp_path / "empty"])


def test_files_of_a_rotated_run_are_one_log(tmp_path: Path) -> None:
    names = ("a.mcap", "a-0001.mcap", "a-0002.mcap", "b.mcap", "b-copy.mcap")
    for name in names:
        (tmp_path / name).touch()
    assert [[file.name for file in log] for log in logs_of([tmp_path])] == [
        ["a.mcap", "a-0001.mcap", "a-0002.mcap"],
        ["b.mcap"],
    ]
