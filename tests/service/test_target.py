"""Address of a vehicle: an operator's command starts light, and stops a plant whatever else is misconfigured."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings
from aeroloop.service.config_sources import OTHER_SECTIONS, ConfigError, Target, load_target
from aeroloop.service.host import operator


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
    "given", ["netwrok.mode=peer", "network.mod=peer", "vehicle=a/b", "network.mode=mesh", "x.y=1"]
)
def test_a_wrong_vehicle_network_or_name_of_a_section_is_refused(given: str) -> None:
    with pytest.raises(ConfigError, match=given.partition("=")[0].partition(".")[0]):
        load_target(None, [given])


def test_every_plant_is_stopped_unless_a_vehicle_is_configured(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[str | None] = []

    def stop(_: object, vehicle: str | None) -> operator.Stopped:
        stopped.append(vehicle)
        return operator.Stopped(["at 0 V"], [])

    monkeypatch.setattr(operator, "stop", stop)
    for words in ((), ("--set", "vehicle=aero"), ("--set", "vehicle=aero", "--all")):
        assert execute(["op", "stop", *words]) == 0
    assert stopped == [None, "aero", None]
