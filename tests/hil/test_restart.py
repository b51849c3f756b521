"""A controller that was killed and is started again: nothing moves that was not asked for."""

from __future__ import annotations

import shlex
from math import degrees

import pytest

from aeroloop.protocol.messages.models import SessionRecord, Truth
from aeroloop.protocol.messages.operator import Gains, Hold, Sinusoid, Track
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.service.host.operator import send, show
from aeroloop.service.logs.replay import replay
from aeroloop.service.testing.hil import Hil
from tests.hil.test_faults import PATIENT
from tests.hil.test_operate import done

TARGET = Hold(attitude=(0.0, -10.0, 30.0))
SET = Gains(C1=(0.4, 0.4, 0.4), C2=(0.2, 0.2, 0.2), Gamma=(0.02, 0.02, 0.02))
CONFIGURED = Gains(C1=(0.3, 0.3, 0.3), C2=(0.15, 0.15, 0.15), Gamma=(0.02, 0.02, 0.02))


SWING = Sinusoid(amplitude=(0.0, 10.0, 20.0))


def shown(hil: Hil, *, last: bool = False) -> SessionRecord:
    """What `op show` reads."""
    return show(hil.settings.network, "aero", last=last)


@pytest.mark.parametrize("after_restart", ["hold", "resume", "configured"])
def test_what_a_controller_that_was_killed_does_when_it_is_started_again(hil: Hil, after_restart: str) -> None:
    mode = {"controller.auto_arm": True, "controller.after_restart": after_restart}
    hil.start(settings={**PATIENT, **mode, "reference.amplitude": SWING.amplitude})
    send(hil.settings.network, "aero", "track", Track(reference=TARGET, within_s=1.5))
    send(hil.settings.network, "aero", "set_gains", Gains(C1=SET.C1, C2=SET.C2))
    hil.run(1.0)
    before = shown(hil)
    assert (before.reference, before.reference_from, before.gains, before.gains_from) == (
        TARGET, "operator", SET, "operator",
    )  # fmt: skip
    hil.kill("controller")
    hil.eventually("the trip", lambda: hil.state("plant") == "tripped")
    hil.run(0.5)  # the body swings at 0 V
    left = shown(hil, last=True)
    assert (left.session, left.reference, left.gains) == (before.session, TARGET, SET)
    hil.restart("controller")
    hil.eventually("driving", lambda: hil.status("controller").session not in (None, before.session))
    hil.eventually("driving", lambda: hil.state("controller") == "running")
    hil.run(2.5)
    status, after = hil.status("controller"), shown(hil)
    assert (status.reference_from, status.gains_from) == (after.reference_from, after.gains_from)
    assert after.session == status.session != before.session
    if after_restart == "hold":
        assert (after.reference_from, after.gains, after.gains_from) == ("held", CONFIGURED, "configured")
        pasted = done(hil, "show").splitlines()[1]
        verb, *words = shlex.split(pasted, comments=True)[2:]
        done(hil, verb, *words[: words.index("--set")])
        now = shown(hil)
        assert (now.reference, now.reference_from) == (after.reference, "operator")
    elif after_restart == "resume":
        assert (after.reference, after.reference_from) == (TARGET, "resumed")
        assert (after.gains, after.gains_from) == (SET, "resumed")
    else:
        assert (after.reference, after.gains) == (SWING, CONFIGURED)
    log = hil.log
    truths = [truth for _, truth in log.messages("truth") if isinstance(truth, Truth)]
    driven = [truth for truth in truths if truth.session == after.session]
    first, last = ([degrees(angle) for angle in to_euler(truth.attitude)] for truth in (driven[0], driven[-1]))
    if after_restart == "hold":  # 8 bits of ε are 0.9°, and the hold begins while the body still swings a little
        assert last == pytest.approx(first, abs=6.0)
        assert isinstance(after.reference, Hold)
        assert after.reference.attitude is not None
        assert last == pytest.approx(after.reference.attitude, abs=4.0)
    elif after_restart == "resume":
        assert last == pytest.approx(TARGET.attitude, abs=6.0)
    again = replay([log.path])
    assert again.controller is not None
    assert (again.controller.differ, len(again.sessions)) == (0, 2)
    assert again.plant is not None
    assert again.plant.differ == 0
