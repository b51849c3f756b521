"""Judge a change by logs, beside your tests: the same commands, and a closed loop that tracks no worse.

pytest test_logs.py                      # the logs are in the folder `logs` beside this file
aeroloop log check logs --accept         # what differs on purpose is expected from then on
"""

from pathlib import Path

import pytest

import aeroloop

LOGS = sorted((Path(__file__).parent / "logs").glob("*.mcap"))


@pytest.mark.parametrize("log", LOGS, ids=lambda log: log.stem)
def test_a_log_gives_the_same_commands_and_its_loop_tracks_no_worse(log: Path) -> None:
    (found,) = aeroloop.check_logs([log], trust_law=True)  # our own logs: what they name is our code
    assert found.same, found.error or found.unseen or found.first
    before, after = (figures.z_track if figures else None for figures in (found.before, found.after))
    if before is not None and after is not None:
        assert after <= 1.05 * before
