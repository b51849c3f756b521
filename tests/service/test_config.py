"""Configuration: every key explains itself, wrong ones are named with a remedy, and nothing is taken silently."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Hold, Points, Sinusoid, Stream
from aeroloop.protocol.wording import keys
from aeroloop.service.cli.main import execute
from aeroloop.service.config import ENV_PREFIX, ConfigError, PointsFile, Settings, from_description, load
from aeroloop.service.config_sources import BODY, OTHER_SECTIONS, Target, load_target
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import MODELS
from aeroloop.service.host import operator
from aeroloop.service.settings import read_points
from tests.support.hostile import mutated

KEYS = keys(Settings)
LEAVES = [key for key in KEYS if not any(other.startswith(f"{key}.") for other in KEYS)]
KINDS: dict[str, tuple[Any, ...]] = {
    "reference": (Sinusoid, Hold, Points, Stream, PointsFile),
    "law": tuple(MODELS.values()),
}


@pytest.mark.parametrize("depth", [100, 500, 5_000])
@pytest.mark.parametrize("opening", ["[", "{a="])
def test_a_file_or_an_override_that_is_nested_too_deeply_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], depth: int, opening: str
) -> None:
    nested = opening * depth + "1" + {"[": "]", "{a=": "}"}[opening] * depth
    file = tmp_path / "deep.toml"
    texts = [f"x = {nested}", f"[plant.own]\nx = {nested}", f"[plant.own{'.a' * depth}]\nb = 1", "x = " + "[" * 5_000]
    for text in texts:
        file.write_text(text)
        assert execute(["show", "config", "--config", str(file)]) == 2
        assert capsys.readouterr().err.startswith(f"aeroloop: {file}: nested too deeply, more than 32 ")
    for override in (f"plant.own.x={nested}", f"plant.own{'.a' * depth}=1"):
        assert execute(["show", "config", "--set", override, "--set", override]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "nested too deeply" in line
        assert len(line) < 200


def test_every_key_is_described_and_a_quantity_has_a_unit() -> None:
    assert [key for key, field in KEYS.items() if not field.description] == []
    quantities = {key: field.description or "" for key, field in KEYS.items() if "float" in str(field.annotation)}
    assert [key for key, description in quantities.items() if "[" not in description] == []


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("loop.rate=1", "unknown key loop.rate: did you mean loop.rate_hz?"),
        ("lop.rate_hz=1", "unknown key lop: did you mean loop?"),
        ("law.c1=1", "unknown key law.c1: did you mean law.C1?"),
        ("plant.mass=1", "unknown key plant.mass: did you mean plant.aero.mass?"),
        ("law.kp=1", "law.kp is no key of this kind"),
        ("loop.rate_hz=0.5", "loop.rate_hz: should be greater than or equal to 1, not 0.5"),
        ("loop=3", "loop: should be a valid dictionary or instance of LoopSettings, not 3"),
        ("wire.rate.bits=17", "wire.rate.bits: should be less than or equal to 16, not 17"),
        (
            "reference.kind=hole",
            "reference: tag 'hole' found using 'kind' does not match any of the expected tags: "
            "'sinusoid', 'hold', 'points', 'stream'",
        ),
        ("reference.frequency=[0,1,-1]", "reference.frequency[2]: should be greater than or equal to 0, not -1"),
        (
            "network.rendezvous=7547",
            "network.rendezvous[0]: must be a Zenoh endpoint, PROTOCOL/ADDRESS:PORT such as tcp/127.0.0.1:7447, "
            "not 7547",
        ),
    ],
)
def test_a_wrong_setting_is_named_with_what_it_must_be(override: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(overrides=[override])
    assert str(caught.value) == line


def test_every_key_can_be_set_in_the_environment() -> None:
    """None is refused as unknown; what it must be is not the matter here."""
    for key in LEAVES:
        section, _, name = key.partition(".")
        kinds = [kind.model_fields["kind"].default for kind in KINDS.get(section, ()) if name in kind.model_fields]
        with pytest.MonkeyPatch.context() as patch:
            if kinds:
                patch.setenv(f"AEROLOOP_{section.upper()}__KIND", kinds[0])
            patch.setenv(ENV_PREFIX + key.upper().replace(".", "__"), "[[[{a = 1}]]]")
            with pytest.raises(ConfigError, match=key.split(".")[-1]) as caught:
                load()
        assert not re.search("unknown|environment", str(caught.value))


def test_file_environment_and_set_replace_each_other_in_this_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.toml"
    path.write_text("vehicle = 'file'\n[loop]\nrate_hz = 100.0\n")
    assert load(path).vehicle == "file"
    monkeypatch.setenv("AEROLOOP_VEHICLE", "environment")
    monkeypatch.setenv("AEROLOOP_LOOP__LOCKSTEP", "true")
    monkeypatch.setenv("AEROLOOP_CAN__OPTIONS__BITRATE", "7")
    monkeypatch.setenv("AEROLOOP_LAW__KIND", "my:Law")
    monkeypatch.setenv("AEROLOOP_LAW__K", "[1, 2]")
    monkeypatch.setenv("AEROLOOP_NETWORK__RENDEZVOUS", "tcp/127.0.0.1:7999")
    loaded = load(path)
    assert loaded.law.model_extra == {"k": [1, 2]}
    assert loaded.network.rendezvous == ["tcp/127.0.0.1:7999"]
    assert (loaded.vehicle, loaded.loop.rate_hz, loaded.loop.lockstep) == ("environment", 100.0, True)
    assert loaded.can.options == {"bitrate": 7}
    assert load(path, ["vehicle=option"]).vehicle == "option"


@pytest.mark.parametrize(
    ("variable", "hint"),
    [
        ("AEROLOOP_LOP__RATE_HZ", "AEROLOOP_LOOP__RATE_HZ"),
        ("AEROLOOP_LOOP_RATE_HZ", "AEROLOOP_LOOP__RATE_HZ"),
        ("AEROLOOP_DEBUG", "unset it"),
    ],
)
def test_a_variable_that_is_no_setting_is_refused(variable: str, hint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable, "200")
    with pytest.raises(ConfigError, match=f"^{variable} in the environment is no setting: .*{hint}"):
        load()


def test_a_description_is_read_without_the_environment_and_keys_of_other_versions_but_with_a_users_keys(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = load(overrides=["law.kind=my:Law", "law.k=3", "can.options={a = 1}", "plant.kind=my:P", "plant.own.b=2"])
    old = settings.description()
    for section in (old, old["loop"], old["network"]["security"], old["reference"], old["wire"]["rate"]):
        section["gone"] = 1
    del old["loop"]["rate_hz"]
    monkeypatch.setenv("AEROLOOP_LOOP__RATE_HZ", "100")
    monkeypatch.setenv("AEROLOOP_LOP", "1")
    assert from_description(old) == settings
    old["law"] = {"kind": "pd", "gone": 1}
    assert from_description(old).law.kind == "pd"


OVERRIDES: tuple[tuple[str, ...], ...] = (
    ("reference.kind=hold", "wire.rate.bits=cont", "recorder.path=a b.mcap", "controller.duration_s=3"),
    ("reference.kind=stream", 'can.options={bitrate = 1000000, "odd key" = "x"}', 'plant.faults=["rate:off@5"]'),
    ("reference.kind=points", "reference.times=[0, 1e-2]", "reference.attitudes=[[0,0,0],[0,1,2]]"),
)


@pytest.mark.parametrize("overrides", OVERRIDES)
@pytest.mark.parametrize("comments", [True, False])
def test_what_is_shown_loads_to_the_same_settings(tmp_path: Path, overrides: tuple[str, ...], comments: bool) -> None:
    settings = load(overrides=overrides)
    path = tmp_path / "a.toml"
    path.write_text(settings.toml(comments=comments), encoding="utf-8")
    assert load(path) == settings


def test_every_key_is_shown_with_its_description_and_bounds_within_100_columns() -> None:
    lines = load().toml(comments=True).splitlines()
    assert max(map(len, lines)) <= 100
    assert not any(line.startswith("#") for line in load().toml().splitlines())
    text = " ".join("\n".join(lines).replace("\n# ", " ").split())
    for key, field in KEYS.items():
        if key.partition(".")[0] not in KINDS:
            assert " ".join((field.description or "").split()) in text, key
    for bounds in ("(number from 1 to 10000)", "(3 × number)", '(whole number from 2 to 16 or "cont")', '"lqr" or'):
        assert bounds in text
    assert "duration_s = (not set)" in text


ROWS = "time,roll,pitch,yaw\n0,0,0,0\n1,0,-5,10\n2,0,0,20\n"
POINTS = Points(times=[0, 1, 2], attitudes=[(0, 0, 0), (0, -5, 10), (0, 0, 20)])


def test_points_of_a_csv_file_are_the_reference_and_stand_in_the_description(tmp_path: Path) -> None:
    (tmp_path / "ref.csv").write_text(ROWS)
    toml = tmp_path / "a.toml"
    toml.write_text('reference = { kind = "file", path = "ref.csv" }\n')
    settings = load(toml)  # from any folder: the path is relative to the TOML file
    assert settings.reference == POINTS
    (tmp_path / "ref.csv").unlink()
    assert from_description(settings.description()) == settings  # no file is needed again
    with pytest.raises(ConfigError, match=r"^reference: cannot read .*ref\.csv"):
        load(toml)


def test_points_without_an_interpolation_are_monotone_and_of_an_older_role_as_it_joined_them() -> None:
    given = load(overrides=["reference.kind=points", "reference.times=[0, 1]", "reference.attitudes=[[0,0,0],[0,1,2]]"])
    assert isinstance(given.reference, Points)
    assert given.reference.interpolation == "monotone"
    described = given.description()
    assert from_description(described) == given
    del described["reference"]["interpolation"]
    older = from_description(described).reference
    assert isinstance(older, Points)
    assert older.interpolation == "differences"


@settings(max_examples=100)
@given(chance=st.randoms(use_true_random=False))
def test_a_mutated_configuration_is_loaded_or_refused_in_one_line(
    chance: Random, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "mutated.toml"
    path.write_bytes(mutated(Settings().toml().encode(), chance))
    said = ""
    try:
        assert isinstance(load(path), Settings)
    except ConfigError as error:
        said = str(error)
    assert len(said.splitlines()) <= 1


def test_another_law_keeps_the_body_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text("[law]\nmass = 2.0\nC1 = [0.5, 0.5, 0.5]\n")
    law = load(file, ["law.kind=pd"]).law
    assert (law.kind, law.mass, law.inertia) == ("pd", 2.0, load().law.inertia)
    assert not hasattr(law, "C1")
    assert set(BODY) == set(LawSettings.model_fields) - {"kind"}


# ── points from a CSV file: what is read, and in one line what is not ──


BARE_ROWS = "0,0,0,0\n1.5,0,10,-20.5\n3e0,0,0,1\n"
BARE_POINTS = Points(times=[0.0, 1.5, 3.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 10.0, -20.5), (0.0, 0.0, 1.0)])


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(BARE_ROWS, id="bare"),
        pytest.param(f'"time [s]","roll\n[deg]",pitch,yaw\n{BARE_ROWS}', id="quoted heading of two lines"),
        pytest.param(BARE_ROWS.replace(",", ", ").replace("1.5", '"1.5"'), id="spaces and quotes"),
        pytest.param("\ufeff" + BARE_ROWS, id="saved by a spreadsheet"),
    ],
)
def test_a_table_of_points_is_read_with_or_without_a_heading(tmp_path: Path, content: str) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(content.encode())
    assert read_points(path) == BARE_POINTS


@pytest.mark.parametrize(
    ("content", "why"),
    [
        pytest.param("1,0,0,0\n2,0,0,0\n", "the first time must be 0", id="what Points refuses"),
        pytest.param("0,0,0,0\n1,0,0\n", r"attitudes\[1\]", id="three"),
        pytest.param("time,roll,pitch,yaw\n0,0,0,0\n\n1,0,,0\n", r"attitudes\[1\]\[1\]: .*number", id="an empty cell"),
        pytest.param(b"0,0,0,0\n\xff\xfe,0,0,0\n", "it is not text", id="bytes"),
        pytest.param(None, "directory", id="a folder"),
    ],
)
def test_what_is_no_table_of_points_is_reported_in_one_line_with_the_file(
    tmp_path: Path, content: str | bytes | None, why: str
) -> None:
    path = tmp_path if content is None else tmp_path / "points.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigError, match=why) as refused:
        read_points(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


# ── counter bits: a frame counter too short to detect late frames is refused, with a remedy ──


@settings(max_examples=80, deadline=None)
@given(
    bits=st.integers(4, 16),
    rate=st.sampled_from([1, 20, 50, 100, 250, 500, 1000, 4000, 10_000]),
    watchdog=st.sampled_from([0.01, 0.1, 0.128, 0.256, 1, 2, 10]),
    stale=st.sampled_from([0.01, 0.1, 0.128, 0.256, 1, 2, 10]),
)
def test_a_counter_counts_twice_the_watchdog_and_the_stale_time_or_the_refusal_states_how_many_bits_would(
    bits: int, rate: int, watchdog: float, stale: float
) -> None:
    loop = (f"loop.rate_hz={rate}", f"plant.watchdog_s={watchdog}", f"controller.stale_s={stale}")
    needed = 2 * max(watchdog, stale) * rate
    if 2**bits >= needed:
        assert load(overrides=[*loop, f"wire.counter_bits={bits}"]).wire.counter_bits == bits
        return
    name = "plant.watchdog_s" if watchdog >= stale else "controller.stale_s"
    with pytest.raises(ConfigError, match=rf"^wire\.counter_bits = {bits} counts .*{name}") as refused:
        load(overrides=[*loop, f"wire.counter_bits={bits}"])
    if found := re.search(r"set it to (\d+)$", str(refused.value)):
        least = int(found[1])
        assert 2 ** (least - 1) < needed <= 2**least
        assert load(overrides=[*loop, f"wire.counter_bits={least}"]).wire.counter_bits == least
    else:
        assert needed > 2**16
        assert f"16 bits are too few; shorten {name}, or lower loop.rate_hz" in str(refused.value)


def test_a_short_counter_is_accepted_in_lockstep_and_on_a_can_bus_whose_frame_holds_no_longer_one() -> None:
    assert load(overrides=["wire.counter_bits=4", "loop.lockstep=true"]).wire.counter_bits == 4
    ten_bits = ("wire.attitude.bits=10", "wire.rate.bits=10", "wire.counter_bits=4")
    assert load(overrides=["plant.via=can", *ten_bits]).wire.counter_bits == 4
    for others in (ten_bits, ["plant.via=can", "can.fd=true", *ten_bits], ["plant.via=can", "wire.counter_bits=4"]):
        with pytest.raises(ConfigError, match=r"set it to 7$"):
            load(overrides=others)


# ── the address of a vehicle: an operator's command starts light, and stops a plant whatever else is misconfigured ──


def test_every_other_section_is_left_unread() -> None:
    assert {*Target.model_fields, *OTHER_SECTIONS} == set(Settings.model_fields)
    assert load_target(None, [f"{name}.x=1" for name in OTHER_SECTIONS]) == Target()


def test_a_mistake_elsewhere_does_not_keep_an_operator_from_a_vehicle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "config.toml"
    file.write_text('vehicle = "beta"\n[loop]\nrate_hz = -1\n[wire]\nvolts = 3\n[plnt]\nx = 1\n')
    monkeypatch.setenv("AEROLOOP_LAW__NONE", "1")
    monkeypatch.setenv("AEROLOOP_LOP__RATE_HZ", "1")
    monkeypatch.setenv("AEROLOOP_NETWORK__MODE", "client")
    found = load_target(file, ["network.insecure=true", "plant.vai=can", "lop=1"])
    assert (found.vehicle, found.network.mode, found.network.insecure) == ("beta", "client", True)


@pytest.mark.parametrize(
    ("variable", "file", "about"),
    [
        ("AEROLOOP_DEBUG", "", "AEROLOOP_DEBUG in the environment is no setting: unset it"),
        ("AEROLOOP_X__Y", "", "AEROLOOP_X__Y in the environment is no setting: unset it"),
        ("AEROLOOP_LOOP_RATE_HZ", "", "AEROLOOP_LOOP_RATE_HZ in the environment is no setting"),
        ("", "[x]\ny = 1\n", "x in the configuration is no setting"),
    ],
)
def test_what_is_unknown_is_a_warning_to_an_operator_s_verb_and_an_error_to_a_daemon(
    variable: str, file: str, about: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config.toml"
    path.write_text(file)
    if variable:
        monkeypatch.setenv(variable, "1")
    warnings: list[str] = []
    assert load_target(path, (), warnings.append) == Target()
    (warning,) = warnings
    assert warning.startswith(about)
    with pytest.raises(ConfigError):
        load(path)


@pytest.mark.parametrize("variable", ["NETWRK__MODE", "NETWORK_MODE", "VEHICEL", "MODE", "RENDEZVOUS", "NETWORK__MOD"])
def test_a_variable_that_may_be_meant_as_vehicle_or_network_is_refused(
    variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ENV_PREFIX + variable, "client")
    with pytest.raises(ConfigError, match=variable):
        load_target()


@pytest.mark.parametrize(
    "given", ["netwrok.mode=peer", "network.mod=peer", "vehicle=a/b", "network.mode=mesh", "rendezvous=tcp/h:1"]
)
def test_a_wrong_vehicle_network_or_name_of_a_section_is_refused(given: str) -> None:
    with pytest.raises(ConfigError, match=given.partition("=")[0].partition(".")[0]):
        load_target(None, [given])


def test_every_plant_is_stopped_unless_a_vehicle_is_configured(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped: list[str | None] = []

    def stop(_: object, vehicle: str | None, on_answer: Callable[[str], object]) -> operator.Stopped:
        stopped.append(vehicle)
        on_answer("at 0 V")
        return operator.Stopped(["at 0 V"], [])

    monkeypatch.setattr(operator, "stop", stop)
    for words in ((), ("--set", "vehicle=aero"), ("--set", "vehicle=aero", "--all")):
        assert execute(["op", "stop", *words]) == 0
        assert capfd.readouterr().out == "at 0 V\n"  # once
    assert stopped == [None, "aero", None]
