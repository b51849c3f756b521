"""Configuration: every key explains itself, wrong ones are named with a remedy, and nothing is taken silently."""

from __future__ import annotations

import re
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Hold, Points, Sinusoid, Stream
from aeroloop.protocol.wording import keys
from aeroloop.service.config import ENV_PREFIX, ConfigError, PointsFile, Settings, from_description, load
from aeroloop.service.config_sources import BODY
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import MODELS
from tests.support.hostile import mutated

KEYS = keys(Settings)
LEAVES = [key for key in KEYS if not any(other.startswith(f"{key}.") for other in KEYS)]
KINDS: dict[str, tuple[Any, ...]] = {
    "reference": (Sinusoid, Hold, Points, Stream, PointsFile),
    "law": tuple(MODELS.values()),
}


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
