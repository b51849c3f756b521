"""Certificate gate: publishes each change of the verdict, and refuses to drive without a required one."""

from __future__ import annotations

import threading

import pytest

from aeroloop.protocol.messages.operator import Gains, Hold, Reference, Sinusoid, Stream, Track
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.registry import gains_of
from aeroloop.service.daemon import certificate_gate
from aeroloop.service.daemon.certificate_gate import UncertifiedError, Verdict
from aeroloop.service.settings import ControllerSettings
from tests.support.certified import certified_settings
from tests.support.operated_loop import LAW, LEVEL, Loop, gains_with
from tests.support.zenoh_network import PATIENCE_S, eventually

FAILING = Gains(C2=(0.03, 0.03, 0.03))
BETTER = Gains(C2=(0.2, 0.2, 0.2))


def of(gains: Gains) -> AdaptiveSettings:
    return LAW.model_copy(update=gains.named)


class Certified(Loop):
    """A loop whose OperatorChanges asks for certificates."""

    def __init__(self, *, required: bool, reference: Reference | None = None) -> None:
        settings = ControllerSettings(require_certificate=required, after_restart="configured")
        certified = certified_settings().model_copy(update={"controller": settings})
        super().__init__(reference or Sinusoid(), settings, certified=certified)

    @property
    def verdicts(self) -> list[tuple[str, str]]:
        """What was reported of the theorem: kind, text."""
        words = ("the certificate ", "nothing is certified")
        kinds = ("started", "changed", "fault")
        return [(kind, text) for kind in kinds for text in self.events(kind) if any(word in text for word in words)]


@pytest.fixture
def certified() -> Certified:
    """A session of a controller that must be certified, and is."""
    loop = Certified(required=True)
    loop.gate.publish()
    loop.begin()
    loop.tick()
    return loop


def wait_for_threads() -> None:
    """Until what is computed beside the loop is done."""
    for thread in threading.enumerate():
        if thread.daemon and thread is not threading.current_thread() and "verdict_of" in thread.name:
            thread.join(30)


def test_the_verdict_is_reported_once_and_again_when_it_changes(certified: Certified) -> None:
    certified.gate.publish()
    ((kind, text),) = certified.verdicts
    assert kind == "started"
    assert text.startswith("the certificate holds: once there, ‖z‖ stays within 0.02")
    asked = certified.ask("set_gains", Gains(C1=LAW.C1))  # which they are already
    certified.tick()
    assert asked.answers[0].done
    assert len(certified.verdicts) == 1
    asked = certified.ask("set_gains", BETTER)
    certified.tick()
    assert asked.answers[0].done
    kind, text = certified.verdicts[-1]
    assert (kind, "stays within 0.021" in text) == ("changed", True)


def test_gains_of_which_it_would_not_hold_are_refused_with_the_reason_and_a_remedy(certified: Certified) -> None:
    asked = certified.ask("set_gains", FAILING)
    certified.tick()
    (answer,) = asked.answers
    assert not answer.done
    assert len(answer.text.splitlines()) == 1
    assert "the certificate does not hold: pointwise: no invariant set is proven with" in answer.text
    assert "what would do: " in answer.text
    assert "law.C2 = [0.0" in answer.text
    assert certified.controller.gains.C1 == LAW.C1
    assert certified.gate.blocks is None
    assert len(certified.verdicts) == 1


def test_a_stream_is_refused_and_what_can_be_certified_is_followed(certified: Certified) -> None:
    asked = certified.ask("track", Track(reference=Stream()))
    certified.tick()
    assert not asked.answers[0].done
    assert "set-points are not known beforehand" in asked.answers[0].text
    asked = certified.ask("track", Track(reference=Hold(attitude=(0.0, 5.0, 5.0)), within_s=2.0))
    certified.tick()
    assert asked.answers[0].done
    assert certified.verdicts[-1][0] == "changed"


def test_two_changes_that_hold_by_themselves_are_not_both_taken_if_together_they_do_not(certified: Certified) -> None:
    less, more = Gains(C1=(0.1, 0.1, 0.1)), Gains(C2=(0.048, 0.048, 0.048))
    for alone in (less, more):
        assert certified.gate.verdict_of(gains_of(of(alone)), Sinusoid()).holds
    asked = [certified.ask("set_gains", gains) for gains in (less, more)]
    certified.tick()
    assert [one.answers[0].done for one in asked] == [True, False]
    assert certified.controller.gains == gains_of(of(less))


def test_where_nothing_is_required_all_is_accepted_and_reported() -> None:
    loop = Certified(required=False)
    loop.begin()
    asked = [loop.ask("set_gains", FAILING), loop.ask("track", Track(reference=Stream()))]
    loop.tick()
    wait_for_threads()
    loop.tick()
    assert all(one.answers[0].done for one in asked)
    assert "nothing is certified" in loop.verdicts[-1][1]
    assert loop.gate.blocks is None
    assert not loop.events("fault")


def test_where_it_comes_to_rest_is_certified_beside_the_loop(certified: Certified) -> None:
    asked = certified.ask("track", Track(reference=Hold(), within_s=2.0))
    certified.tick()
    assert asked.answers[0].done
    wait_for_threads()
    certified.tick()
    assert certified.verdicts[-1][0] == "changed"
    assert certified.gate.blocks is None


def test_what_is_read_again_blocks_and_unblocks_the_next_claim() -> None:
    loop = Certified(required=True)
    loop.gate.publish()
    for gains in (FAILING, BETTER):
        loop.gate.verdict_of(*loop.live.prospect(of(gains), Sinusoid()))
        loop.live.adopt(of(gains), Sinusoid())
        blocks = loop.gate.blocks
        if gains is FAILING:
            assert blocks is not None
            assert blocks.startswith("claims no vehicle, as controller.require_certificate is set: the certificate ")
            (fault,) = loop.events("fault")
            assert fault.startswith(blocks)
            assert "law.C2 = [0.0" in fault
        else:
            assert blocks is None
    assert [kind for kind, _ in loop.verdicts] == ["started", "changed", "fault"]


def test_what_was_not_weighed_beforehand_counts_as_failing_until_it_is() -> None:
    loop = Certified(required=True)
    loop.live.adopt(of(BETTER), Sinusoid())
    assert "not known yet" in (loop.gate.blocks or "")
    wait_for_threads()
    loop.role.take_inbox()
    assert loop.gate.blocks is None


def test_what_must_hold_and_does_not_is_not_admitted(certified: Certified) -> None:
    with pytest.raises(UncertifiedError, match="does not hold"):
        certified.gate.admit(gains_of(of(FAILING)), Sinusoid())
    certified.gate.admit(gains_of(of(FAILING)), Sinusoid(), required=False)
    certified.gate.required = False
    certified.gate.admit(gains_of(of(FAILING)), Sinusoid())


def test_of_changes_that_follow_each_other_fast_the_first_and_the_last_are_certified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One thread at a time: an operator whose program runs wild would have as many as changes."""
    gate = Loop(LEVEL).gate
    begun, may_end = list[Gains](), threading.Event()
    verdict = gate.verdict_of(Gains(), LEVEL)

    def slow(gains: Gains, _: Reference) -> Verdict:
        begun.append(gains)
        may_end.wait(PATIENCE_S)
        return verdict

    monkeypatch.setattr(gate, "verdict_of", slow)
    monkeypatch.setattr(certificate_gate, "PAUSE_S", 0.0)
    changes = [gains_with(C1=(1.0 + number / 8, 1.0, 1.0)) for number in range(5)]
    gate.take(changes[0], LEVEL)
    eventually("the first", lambda: begun == changes[:1])
    for change in changes[1:]:
        gate.take(change, LEVEL)
    may_end.set()
    eventually("the last", lambda: begun[-1:] == changes[-1:])
    assert begun == [changes[0], changes[-1]]
