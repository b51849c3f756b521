"""Bench lock: a second driver of one bench on a host is refused, with the first one's process named."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import AbstractContextManager
from multiprocessing.synchronize import Event

import pytest

from aeroloop.plant_emulator.hosts.bench_lock import BenchError, can_bench, quanser_bench
from aeroloop.plant_emulator.settings import PlantSettings, QuanserSettings
from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.service.config import load
from aeroloop.service.daemon.roles import run_plant
from tests.support.operated_loop import LEVEL, Loop

BOARD = QuanserSettings(card_identifier=f"of pid {os.getpid()}")
"""Test files run beside each other on one host, so each has a board and a bus of its own."""
BUS = CanSettings(interface="socketcan", channel=f"can{os.getpid()}")


def bench(name: str) -> AbstractContextManager[None]:
    if name == "board":
        return quanser_bench(BOARD)
    return can_bench(BUS, "controller" if name == "bus" else "plant")


@pytest.mark.parametrize("name", ["board", "bus", "node"])
def test_a_second_driver_of_a_bench_is_refused_until_the_first_has_ended(name: str) -> None:
    with bench(name):
        with pytest.raises(BenchError, match=rf"pid {os.getpid()} \(.*python.*\) drives") as refusal, bench(name):
            pass
        assert "\n" not in str(refusal.value)
    with bench(name):
        pass


def test_other_nodes_channels_ends_and_boards_are_other_benches() -> None:
    other_port = BUS.model_copy(update={"options": {"port": 7}})
    other_board = QuanserSettings(card_identifier=f"another of pid {os.getpid()}")
    with (
        can_bench(BUS, "controller"),
        can_bench(BUS, "plant"),
        can_bench(BUS.model_copy(update={"node": 2}), "controller"),
        can_bench(BUS.model_copy(update={"channel": "can-other"}), "controller"),
        can_bench(other_port, "controller"),
        quanser_bench(BOARD),
        quanser_bench(other_board),
    ):
        pass


def hold(held: Event) -> None:
    """Hold the board until this process is killed."""
    with quanser_bench(BOARD):
        held.set()
        Event.wait(multiprocessing.get_context("fork").Event())


def test_a_killed_driver_leaves_no_lock() -> None:
    context = multiprocessing.get_context("fork")
    held = context.Event()
    driver = context.Process(target=hold, args=(held,))
    driver.start()
    assert held.wait(30)
    with pytest.raises(BenchError, match=f"pid {driver.pid} "), quanser_bench(BOARD):
        pass
    driver.kill()
    driver.join()
    with quanser_bench(BOARD):
        pass


@pytest.mark.parametrize("via", ["can", "quanser"])
def test_a_plant_end_on_hardware_takes_the_lock_before_it_opens_the_bench(via: str) -> None:
    """Neither the bus nor the board's package exists here, so whatever is opened first fails in other words."""
    settings = load(overrides=[f"plant.via={via}", "can.interface=socketcan", f"can.channel={BUS.channel}"])
    settings.plant = PlantSettings.model_validate(settings.plant.model_dump() | {"quanser": BOARD.model_dump()})
    with bench("bus" if via == "can" else "board"), pytest.raises(BenchError):
        run_plant(Loop(LEVEL).role, settings)
