"""`op stop` while a stranger's host floods the roles' ports: by the other carrier, by the firewall, by the controller.

Network namespaces of this machine. Slack: no time is asserted but the command's own, which tries for 10 s; alone it
takes 0.6 s. A watchdog of 2 s keeps a busy machine from tripping the plant by itself.
`python -m tests.benchmarks.floods` counts many more tries.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.deployment import Kind
from tests.support.flooded import FloodedDeployment
from tests.support.namespaces import NoNamespacesError

TRIES = 3


def connections_at_every_role(hosts: FloodedDeployment) -> None:
    hosts.flood("tcp", "50")


def half_open_ones_at_every_role(hosts: FloodedDeployment) -> None:
    hosts.flood("half-open", "200")


def both_carriers_behind_the_firewall(hosts: FloodedDeployment) -> None:
    hosts.limit_newcomers()
    hosts.flood("tcp", "50")
    hosts.flood("quic", "20")


def both_carriers_at_the_plant(hosts: FloodedDeployment) -> None:
    """The controller, which is linked to it, passes the stop on."""
    hosts.flood("tcp", "50", roles=["plant"])
    hosts.flood("quic", "50", roles=["plant"])


def connections_at_the_router(hosts: FloodedDeployment) -> None:
    hosts.flood("tcp", "50", roles=["router"])


@pytest.mark.parametrize(
    ("kind", "flood"),
    [
        ("peers", connections_at_every_role),
        ("peers", half_open_ones_at_every_role),
        ("peers", both_carriers_behind_the_firewall),
        ("peers", both_carriers_at_the_plant),
        ("router", connections_at_the_router),
    ],
)
def test_a_stop_gets_through_a_flood(kind: Kind, flood: Callable[[FloodedDeployment], None], tmp_path: Path) -> None:
    try:
        with FloodedDeployment(tmp_path, kind) as hosts:
            hosts.start()
            flood(hosts)
            hosts.await_floods()
            for _ in range(TRIES):
                attempt = hosts.try_to_stop()
                assert attempt.stopped, attempt
            hosts.await_operators_trips(TRIES)
    except NoNamespacesError as error:
        pytest.skip(f"no network namespaces here, or no nft or tc: {error}")
