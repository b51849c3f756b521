"""`hil` without processes: errors before `start`, settings, figures of an ended run, evidence of a failure."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.trace import Sent
from aeroloop.service.config import as_overrides, load
from aeroloop.service.review.review import read
from aeroloop.service.testing.hil import Hil, HilError, HilLog
from aeroloop.service.testing.hil_log import RunFigures
from tests.support.made_log import make_log


@pytest.mark.parametrize("use", ["run", "goto", "kill", "settings", "state", "log"])
def test_before_start_it_says_what_to_call_first(use: str, tmp_path: Path) -> None:
    words = {"run": (1.0,), "goto": (0, 0, 10), "kill": ("plant",), "state": ("plant",)}
    with pytest.raises(HilError, match=r"call `hil\.start\(\)` first"):
        getattr(Hil(tmp_path), use)(*words[use])


def test_settings_may_be_nested_or_dotted_or_both() -> None:
    dotted = {"vehicle": "b", "loop.rate_hz": 200, "wire.rate.bits": 10, "can.options": {"port": 7}}
    nested = {"vehicle": "b", "loop": {"rate_hz": 200}, "wire": {"rate.bits": 10}, "can": {"options.port": 7}}
    loaded = load(overrides=as_overrides(nested))
    assert (loaded.loop.rate_hz, loaded.wire.rate.bits, loaded.can.options) == (200, 10, {"port": 7})
    assert loaded == load(overrides=as_overrides(dotted))


def test_a_figure_that_the_log_lacks_is_an_error_with_its_reason(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 20)
    judged = read(tmp_path / "a.mcap").findings
    figures = RunFigures(judged)
    assert figures.z_track == judged.z_track
    assert figures.model_dump() == judged.model_dump()
    assert repr(figures) == f"figures of session {judged.session}"  # pytest prints it in a failed assertion
    lacking = RunFigures(judged.model_copy(update={"z_track": None, "reasons": {"z_track": "nothing answered"}}))
    with pytest.raises(HilError, match="the log gives no z_track: nothing answered"):
        _ = lacking.z_track
    with pytest.raises(HilError, match="session"):
        HilLog(tmp_path / "a.mcap").figures_of(7)


def test_times_are_those_of_frames_and_not_of_silence(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 200, settings=load(overrides=["loop.lockstep=true", 'wire.transmit="on_change"']))
    log = HilLog(tmp_path / "a.mcap")
    silent = sum(int((batch.columns["sent_as"] == Sent.SILENT).sum()) for batch in log.batches("controller"))
    assert silent > 0
    assert len(log.times("controller", "sent")) == 200 - silent


def test_evidence_is_a_page_and_the_events_beside_the_log(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 50)
    paths = [Path(line.partition(": ")[0]) for line in HilLog(tmp_path / "a.mcap").evidence([])]
    assert [path.name for path in paths] == ["a.mcap", "a-events.txt", "a.html"]
    assert all(path.stat().st_size for path in paths)
    assert "</html>" in (tmp_path / "a.html").read_text()


def test_evidence_of_a_log_that_cannot_be_read_names_the_reason_and_has_the_events_received(tmp_path: Path) -> None:
    event = Event(role="plant", kind="tripped", text="no command for 100 ms: 0 V", session="s1", tick=7)
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    *_, last = HilLog(tmp_path / "a.mcap").evidence([event])
    assert last.startswith("no page: ReviewError: ")
    assert "no command for 100 ms: 0 V  (tick 7)" in (tmp_path / "a-events.txt").read_text()
    assert list(HilLog(tmp_path / "b.mcap").evidence([event])) == [f"{tmp_path / 'b.mcap'}: no log was written"]
