"""A process that is halted, killed or started again, whichever came first: operators, newcomers and the rest go on.

The halted one holds its port, and the kernel accepts connections for it: none of the others may wait for it. Slack: the
watchdog of `PATIENT`; what is waited for has half a minute.
"""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Final

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Request
from aeroloop.protocol.transport.network import join
from aeroloop.service.config import Settings, load
from aeroloop.service.host.operator import OperatorError, gather, send, stop
from aeroloop.service.testing.process_group import ProcessGroup, RoleName, standalone
from tests.support.processes import PATIENT
from tests.support.zenoh_network import eventually

ROLES: Final[tuple[RoleName, ...]] = ("recorder", "plant", "controller")
AT_REST: Final = "aero is at 0 V; `aeroloop op arm` lets it be driven again"


def assert_operable(settings: Settings, missing: RoleName, *, halted: bool) -> None:
    """Status, stop, arm and a newcomer work without one role; a halted one is named."""
    network = settings.network
    names = [f"the {missing} with pid "] if halted else []
    statuses, silent = gather(network)
    assert set(statuses["aero"]) >= set(ROLES) - {missing}
    assert [line[: len(name)] for line, name in zip(silent, names, strict=True)] == names
    for _ in range(2):  # the second time it is at 0 V already
        answers, failures = stop(network)
        if missing == "plant":
            assert answers == []
            assert len(failures) == 1
            assert failures[0].startswith(names[0] if names else "no plant answers")
        else:
            assert (answers, failures) == ([AT_REST], [])
    if missing == "plant":
        with pytest.raises(OperatorError, match=names[0] if names else "no plant of aero answers"):
            send(network, "aero", "arm", Request())
    else:
        assert "aero is armed" in send(network, "aero", "arm", Request())
    with join(network) as newcomer:
        found: set[str] = set()
        subscriber = newcomer.declare_subscriber(topics.key("status", "aero"), lambda s: found.add(str(s.key_expr)))
        expected = {topics.key("status", "aero", role=role) for role in ROLES if role != missing}
        eventually("statuses at a newcomer", lambda: found >= expected)
        subscriber.undeclare()


@pytest.mark.parametrize("first", ROLES)
def test_a_process_that_hangs_or_dies_keeps_no_operator_and_no_newcomer_out(tmp_path: Path, first: RoleName) -> None:
    settings = standalone(load(overrides=[f"{key}={value}" for key, value in PATIENT.items()]), tmp_path / "a.mcap")
    with ProcessGroup(settings) as processes:

        def await_driving() -> None:
            def armed() -> bool:
                try:
                    send(settings.network, "aero", "arm", Request())
                except OperatorError as error:
                    return "held by" in str(error)
                return True

            def all_run() -> bool:
                states = {role: status.state for role, status in gather(settings.network).statuses["aero"].items()}
                return states == {"recorder": "recording", "plant": "driven", "controller": "running"}

            # Armed again and again: a controller that was halted within a tick of the law is faulted when it goes on.
            eventually("driving", lambda: armed() and all_run())

        for role in (first, *(role for role in ROLES if role != first)):
            processes.start(role)
            if role != "controller":  # each has a token of its own
                processes.await_role(role)
        await_driving()
        processes.signal(first, signal.SIGSTOP)
        assert_operable(settings, first, halted=True)
        processes.signal(first, signal.SIGCONT)
        await_driving()
        processes.stop(first, signal.SIGKILL)
        assert_operable(settings, first, halted=False)
        processes.start(first, *(["--log", str(tmp_path / "b.mcap")] if first == "recorder" else []))
        await_driving()
