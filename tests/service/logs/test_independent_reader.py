"""Independent MCAP reader on logs of this project: the whole file, as a stream and by the index.

The reader is Foxglove's own, in tests/readers. It checks every checksum and refuses a damaged file.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.recording import rolling
from aeroloop.service.settings import RecorderSettings
from tests.support.edited_log import by_mcap, with_a_damaged_chunk
from tests.support.made_log import lockstep, made

READERS = Path(__file__).parents[2] / "readers"
INSTALL = "npm install --no-package-lock --prefix tests/readers"


def read(*paths: Path) -> subprocess.CompletedProcess[str]:
    """Run the independent reader over some files."""
    node = shutil.which("node")
    if node is None or not (READERS / "node_modules").is_dir():
        assert "CI" not in os.environ, "CI has Node.js and the reader"
        pytest.skip(f"no independent reader: install Node.js, then run `{INSTALL}`")
    return subprocess.run(
        [node, READERS / "count.mjs", *paths], capture_output=True, text=True, check=False, timeout=60
    )


def test_each_file_of_a_rotated_run_is_whole_and_one_that_is_not_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them alone, and together as many messages as were recorded."""
    monkeypatch.setattr(rolling, "CHUNK_S", 1e-9)
    settings = RecorderSettings(path=tmp_path / "run.mcap", max_file_mb=0.005)
    log = rolling.RollingLog(settings, lambda text, _: pytest.fail(text))
    messages = made(lockstep(), 400)
    for i, (at_ns, key, payload, published_ns) in enumerate(messages):
        log.add(Delivery(key, payload, i, published_ns, None), at_ns, [])
        if i % 5 == 4:
            log.tend()
    log.close()
    files, together = sorted(tmp_path.glob("run*.mcap")), Counter[str]()
    assert len(files) > 3
    done = read(*files)
    assert done.returncode == 0, done.stderr
    output = json.loads(done.stdout)
    for path in files:
        ours = {
            topic: {
                "count": len(times),
                "bytes": sum(len(one.data) for one in by_mcap(path) if one.topic == topic),
                "first": str(min(times)),
                "last": str(max(times)),
            }
            for topic in {one.topic for one in by_mcap(path)}
            if (times := [one.log_time for one in by_mcap(path) if one.topic == topic])
        }
        assert output[str(path)]["stream"] == output[str(path)]["index"] == ours
        together.update({topic: its["count"] for topic, its in ours.items()})
    assert together == Counter(message.key for message in messages)
    damaged = with_a_damaged_chunk(files[1], tmp_path / "damaged.mcap")
    (tmp_path / "cut.mcap").write_bytes(files[1].read_bytes()[:-20])
    for path in (damaged, tmp_path / "cut.mcap"):  # otherwise the above would say nothing
        done = read(path)
        assert (done.returncode, done.stdout) == (1, "")
        assert str(path) in done.stderr
