"""Commands that run processes: the demo, and each role alone."""

from __future__ import annotations

import sys
from contextlib import closing
from json import dumps
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from aeroloop.service.cli.common import (
    PAPER_DURATION_S,
    BitsOption,
    Config,
    Duration,
    Json,
    NewLog,
    Overrides,
    load_for_loop,
    load_settings,
    report,
    show,
    working,
)
from aeroloop.service.cli.entry import INTERRUPTED, run_alone, run_role

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.protocol.runtime.node import Node

group = typer.Typer()


@group.command()
def demo(
    duration: Duration = PAPER_DURATION_S,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="Deterministic, as fast as the machine allows.")] = False,
    bits: BitsOption = None,
    log: NewLog = None,
    json: Json = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the paper's experiment in three processes over Zenoh. Then review its log."""
    settings = load_for_loop(config, overrides, *["loop.lockstep=true"] * lockstep, bits=bits)
    from aeroloop.service.lab.demo import run_demo
    from aeroloop.service.terminal.log_sheets import demo_sheets
    from aeroloop.service.terminal.show import demo_progress

    hidden = json or not sys.stderr.isatty()
    if hidden:
        how = "in lockstep" if settings.loop.lockstep else "in real time"
        report(f"{duration:g} s of the experiment {how}, three processes")
    with working("starting", hidden, duration) as update:
        figures, complete = run_demo(settings, duration, log, None if hidden else demo_progress(settings, update))
    show(figures, json, demo_sheets)
    if not json:
        page = Path(figures.log or "").with_suffix(".html")
        report(f"next, draw it: `aeroloop log review {quote(figures.log or '')} --html {quote(str(page))}`")
    if not complete:
        raise typer.Exit(INTERRUPTED)


@group.command()
def controller(
    auto_arm: Annotated[
        bool, typer.Option("--auto-arm", help="Arm the plant with every claim, unless an operator stopped it.")
    ] = False,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Run the controller daemon until SIGTERM."""
    settings = load_for_loop(config, overrides, *["controller.auto_arm=true"] * auto_arm)

    def run(role: Node) -> None:
        from aeroloop.service.control.laws.registry import version_of
        from aeroloop.service.daemon.daemon import Daemon
        from aeroloop.service.theorem.certificate import described_certificate

        daemon = Daemon(role, settings)
        law = version_of(settings.law)
        role.publish_description(settings.description(), described_certificate(settings), law)
        daemon.run()

    run_role("controller", settings, run)


@group.command()
def plant(config: Config = None, overrides: Overrides = None) -> None:
    """Run the plant end that `plant.via` names until SIGTERM. It is the emulator, a CAN bridge or Quanser's board."""
    settings = load_settings(config, overrides)
    from aeroloop.service.daemon.roles import run_plant

    run_role("plant", settings, lambda role: run_plant(role, settings))


@group.command("can-node")
def can_node(config: Config = None, overrides: Overrides = None) -> None:
    """Run the emulated plant as a node on the CAN bus. It may be the firmware's C."""
    settings = load_settings(config, overrides)

    def run(stop: Event) -> None:
        from aeroloop.plant_emulator.hosts.bench_lock import can_bench

        with can_bench(settings.can, "plant"):
            run_node(stop)

    def run_node(stop: Event) -> None:
        if settings.can.node_in_c:
            from aeroloop.service.firmware import node

            node.run(settings, stop)
            return
        from aeroloop.plant_emulator.hosts.can_node import CanNetwork
        from aeroloop.plant_emulator.hosts.driver import Driver

        loop = settings.loop
        with closing(settings.plant.make(loop.period)) as plant:
            endpoint = settings.plant.endpoint(plant, loop, settings.wire)
            Driver(endpoint, CanNetwork(settings.can, loop, endpoint), loop, stop).run()

    run_alone(run)


@group.command()
def router(config: Config = None, overrides: Overrides = None) -> None:
    """Run a router for clients until SIGTERM. They have network.mode = "client"."""
    settings = load_settings(config, overrides)
    from aeroloop.service.daemon.roles import run_router

    run_role("router", settings, run_router)


@group.command()
def recorder(log: NewLog = None, config: Config = None, overrides: Overrides = None) -> None:
    """Record every vehicle on the network into a log until SIGTERM."""
    words = [f"recorder.path={dumps(str(log))}"] if log is not None else []
    settings = load_settings(config, overrides, *words)
    from aeroloop.service.recording.recorder import Recorder

    run_role("recorder", settings, lambda role: Recorder(role, settings.recorder).run())
