"""systemd units: what each configuration's plant needs, no overwriting, next steps, and systemd's own check."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.cli.main import execute as run
from aeroloop.service.config import load
from aeroloop.service.host import units
from aeroloop.service.host.units import UNITS, Source, unit

SLCAN = ("plant.via=can", "can.interface=slcan", "can.channel=/dev/ttyACM0@115200")
VIAS = {
    "emulator": (),
    "quanser": ("plant.via=quanser",),
    "udp_multicast": ("plant.via=can",),
    "socketcan": ("plant.via=can", "can.interface=socketcan", "can.channel=can0"),
    "slcan": SLCAN,
    "gs_usb": ("plant.via=can", "can.interface=gs_usb", 'can.channel="0"'),
}
USB = {"DevicePolicy": "closed", "DeviceAllow": "char-usb_device rw"}
SERIAL = {"DevicePolicy": "closed", "DeviceAllow": "/dev/ttyACM0 rw"}
NONE = {"PrivateDevices": "yes"}


def made(name: str, *overrides: str, config: Path = units.CONFIG) -> dict[str, str]:
    """Directives of a unit."""
    text = unit(name, Source(config, overrides, load(overrides=overrides)))
    lines = [line for line in text.splitlines() if "=" in line and not line.startswith("#")]
    return dict(line.split("=", 1) for line in lines)


@pytest.mark.parametrize(
    ("via", "devices"),
    [
        ("emulator", NONE), ("udp_multicast", NONE), ("socketcan", NONE),
        ("slcan", SERIAL), ("gs_usb", USB), ("quanser", USB),
    ],
)  # fmt: skip
def test_the_plants_unit_may_use_its_bus_or_device_and_the_others_may_not(via: str, devices: dict[str, str]) -> None:
    plant = made("plant", *VIAS[via])
    assert {name: plant[name] for name in plant if name.startswith("Device") or name == "PrivateDevices"} == devices
    assert ("AF_CAN" in plant["RestrictAddressFamilies"].split()) == (via == "socketcan")
    assert ("SupplementaryGroups" in plant) == (via == "slcan")
    for name in ("controller", "recorder"):
        assert made(name, *VIAS[via])["PrivateDevices"] == "yes"
        assert "AF_CAN" not in made(name, *VIAS[via])["RestrictAddressFamilies"]


def test_a_plant_that_systemd_starts_is_unarmed_and_can_keep_a_stop() -> None:
    plant, armed = made("plant"), made("plant", "plant.armed_at_start=true")["ExecStart"]
    assert "--set plant.armed_at_start=false" in plant["ExecStart"]
    assert plant["StateDirectory"] == "aeroloop"
    assert "armed_at_start" not in made("controller")["ExecStart"]
    assert armed.index("armed_at_start=false") < armed.index("armed_at_start=true")  # the user's own wins
    assert made("plant", "plant.state_directory=/srv/aero")["ReadWritePaths"] == "/srv/aero"


def test_clients_get_a_unit_of_a_router_without_rights_and_peers_get_none() -> None:
    assert units.units_of(load(overrides=["network.mode=client"])) == [*UNITS]
    assert units.units_of(load()) == [name for name in UNITS if name != "router"]
    router = made("router", "network.mode=client")
    assert router["CapabilityBoundingSet"] == ""
    assert "LimitRTPRIO" not in router


def test_a_daemon_has_a_user_of_its_own_unless_a_home_or_keys_are_somebodys(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(units, "_HOMES", (tmp_path / "home",))
    config = tmp_path / "home/aeroloop.toml"
    config.parent.mkdir()
    config.touch()
    for name in UNITS:
        assert made(name).items() >= {"DynamicUser": "yes", "ProtectHome": "yes"}.items()
        for found in (
            made(name, config=config), made(name, f"network.security.directory={tmp_path}"),
        ):  # fmt: skip
            assert found["User"] == tmp_path.owner()
            assert "DynamicUser" not in found
    assert made("plant", config=config)["ProtectHome"] == "read-only"
    monkeypatch.setattr(sys, "prefix", str(config.parent))
    assert made("plant").items() >= {"User": config.owner(), "ProtectHome": "read-only"}.items()


def test_units_are_written_over_older_ones_with_the_steps_that_start_them(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["host", "units", "--set", "network.mode=client"]
    assert [run([*words, "--install", str(tmp_path)]) for _ in range(2)] == [0, 0]
    names = " ".join(f"aeroloop-{name}" for name in UNITS)
    assert f"sudo systemctl enable --now {names}\naeroloop op status\n" in capfd.readouterr().out
    assert run(words) == 0
    assert (tmp_path / "aeroloop-plant.service").read_text() in capfd.readouterr().out
    assert run([*words, "--install", str(tmp_path / "nowhere")]) == 1


def test_the_firewall_limits_new_connections_to_the_ports_beyond_this_host(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """That the rules do what they are for: tests/hil/test_floods.py."""
    hosts = 'network.rendezvous=["tcp/10.0.0.1:7447","tls/[fd00::2]:7000"]'
    rules = units.firewall(load(overrides=[hosts, 'network.listen=["tcp/10.0.0.1:7456", "tcp/127.0.0.1:9"]']).network)
    assert rules.count("th dport { 7000-7007, 7447-7454, 7456 }") == 2  # of IPv4 and of IPv6
    router = load(overrides=["network.mode=client", "network.rendezvous=tcp/10.0.0.1:7447"])
    assert units.firewall(router.network).count("th dport { 7447 }") == 2
    assert units.firewall(load().network) == ""  # on loopback
    words = ["host", "units", "--set", hosts]
    assert run(words) == 0
    assert "aeroloop.nft\n# Limits" in capfd.readouterr().out
    assert run([*words, "--install", str(tmp_path)]) == 0
    out = capfd.readouterr().out
    assert f"sudo nft -f {tmp_path}/aeroloop.nft" in out
    assert "inet_service" in (tmp_path / "aeroloop.nft").read_text()


@pytest.mark.parametrize("via", VIAS)
def test_systemd_finds_nothing_wrong_with_any_unit(via: str, tmp_path: Path) -> None:
    systemd = shutil.which("systemd-analyze")
    if systemd is None:
        pytest.skip("systemd-analyze is not installed")
    config = tmp_path / "aero loop.toml"
    config.touch()
    overrides = (*VIAS[via], "network.mode=client")
    source = Source(config, overrides, load(overrides=overrides))
    paths = units.install(tmp_path, source)
    verify = [systemd, "verify", "--man=no", *map(str, paths)]
    checked = subprocess.run(verify, capture_output=True, text=True, timeout=60, check=False)
    about_ours = [line for line in checked.stderr.splitlines() if "aeroloop" in line]
    assert (checked.returncode, about_ours) == (0, [])


@pytest.mark.processes
@pytest.mark.parametrize("name", ["plant", "recorder"])
def test_what_a_unit_starts_is_a_command_line_that_the_daemon_takes(name: str, tmp_path: Path) -> None:
    """The words of ExecStart, with a configuration that makes the daemon end at once."""
    config = tmp_path / "aero loop.toml"
    not_ours = 'listen = ["tcp/192.0.2.1:1"]'
    config.write_text(f'[network]\nrendezvous = ""\n{not_ours}\ninsecure = true\n')
    overrides = ['network.connect=["tcp/127.0.0.1:9?a=$%"]']
    text = unit(name, Source(config, overrides, load(config, overrides)))
    start = next(line for line in text.splitlines() if line.startswith("ExecStart=")).removeprefix("ExecStart=")
    words = shlex.split(start.replace("%L", str(tmp_path)).replace("%%", "%").replace("$$", "$"))
    assert overrides[0] in words
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "cannot listen on tcp/192.0.2.1:1" in done.stderr


def test_what_a_unit_cannot_see_in_tmp_is_named(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "a.toml").touch()
    hidden = tmp_path.is_relative_to("/tmp")  # noqa: S108
    assert run(["host", "units", "--config", str(tmp_path / "a.toml")]) == 0
    assert (f"{tmp_path / 'a.toml'} is in /tmp, which units do not see" in capfd.readouterr().out) == hidden
