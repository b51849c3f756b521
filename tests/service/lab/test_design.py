"""Design: a front that nothing tried beats, whose bounds are the certificate's, and one line where there is none."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise

import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load_over
from aeroloop.service.lab.design import Design, design
from aeroloop.service.theorem.certificate import certify
from tests.support.in_this_process import run_here

SETTINGS = load_over(Settings(), ["law.damping_bound=0.0126"])
SHORT = 0.2


def payload(settings: Settings) -> float:
    wire = settings.wire
    return (wire.measurement.size + wire.command.size) * 8 / settings.loop.period / 1e3


@pytest.fixture(autouse=True, scope="module")
def _no_processes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        run_here(patched)
        yield


@pytest.fixture(scope="module")
def found() -> Design:
    return design(SETTINGS, error_deg=3.5, rates=(250.0, 500.0), duration_s=SHORT)


def test_a_front_falls_in_bound_as_it_rises_in_payload_and_is_what_the_certificate_says(found: Design) -> None:
    assert len(found.front) > 3
    for less, more in pairwise(found.front):
        assert less.kbit_s < more.kbit_s
        assert less.radius > more.radius
    for point in found.front:
        own = load_over(SETTINGS, point.overrides())
        certificate = certify(own, margins=False)
        assert (point.radius, point.degrees) == (certificate.pointwise_radius, certificate.pointwise_deg)
        assert point.degrees <= 3.5
        assert point.kbit_s == pytest.approx(payload(own))
        assert point.z_track is not None
        assert 0 < (point.on_change_kbit_s or 0) < point.kbit_s


@pytest.mark.parametrize("bits", ["8/8/6", "9/6/5", "10/6/6", "9/9/4", "7/11/8", "12/12/12", "11/4/6"])
@pytest.mark.parametrize("rate_hz", [250, 500])
def test_no_other_split_is_below_the_front(found: Design, bits: str, rate_hz: int) -> None:
    other = load_over(SETTINGS, [f"loop.rate_hz={rate_hz}"])
    other = other.model_copy(update={"wire": other.wire.with_bits(bits)})
    radius = certify(other, margins=False).pointwise_radius or float("inf")
    better = [point for point in found.front if point.kbit_s <= payload(other) and point.radius <= radius]
    assert better or radius > found.front[0].radius


def test_delay_and_loss_move_the_front() -> None:
    plain = design(SETTINGS, error_deg=6, kbit=36, duration_s=SHORT).front[-1]
    late = design(SETTINGS, error_deg=9, kbit=36, delay_s=0.004, lost=1, duration_s=SHORT).front[-1]
    assert plain.radius < late.radius


def test_the_verb_prints_the_front_as_json_or_one_line_where_nothing_is_proven(
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert execute(["lab", "design", "--error", "0.01", "--kbit", "40"]) == 1
    assert "is proven to stay within 0.01°" in capfd.readouterr().err
    words = ["--error", "4", "--kbit", "40", "--duration", str(SHORT), "--set", "law.damping_bound=0.0126", "--json"]
    assert execute(["lab", "design", *words]) == 0
    front = json.loads(capfd.readouterr().out)["front"]
    assert [point["bits"] for point in front] == ["10/6/4", "10/6/8"]
