"""Certificate of any law: the paper's, a law's own, or one line that there is none."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pytest

from aeroloop import ExpressionLaw, LawSettings
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.theorem.certificate import CustomCertificate, certificate_of, certify, described_certificate
from aeroloop.service.theorem.feedback import NoTheoremError

HERE = "tests.service.theorem.test_any_law"


class Silent(ExpressionLaw[LawSettings]):
    """Gives 0 V, and says of a heavy body that nothing moves."""

    Settings = LawSettings

    def expressions(self, now: Any) -> tuple[Any, Mapping[str, Any]]:
        return 0 * now.rate[: self.actuators], {}

    @classmethod
    def certify(cls, configured: Any) -> Mapping[str, Any] | None:
        heavy = configured.law.mass > 1
        return {"holds": heavy, "verdict": "Nothing moves." if heavy else "It may blow away.", "decay_rate": 0.5}


class Boastful(Silent):
    """Says that it holds, and nothing else."""

    @classmethod
    def certify(cls, configured: Any) -> Mapping[str, Any] | None:  # noqa: ARG003  # as of its base
        return {"holds": True}


class Careless(Silent):
    """Fails while it certifies."""

    @classmethod
    def certify(cls, configured: Any) -> Mapping[str, Any] | None:  # noqa: ARG003  # as of its base
        raise KeyError("decay")


def test_the_papers_law_has_the_papers_certificate() -> None:
    assert certificate_of(load()) == certify(load())


@pytest.mark.parametrize(("mass", "code", "verdict"), [(2, 0, "Nothing moves."), (0.5, 1, "It may blow away.")])
def test_a_law_that_brings_a_certificate_has_its_own(
    mass: float, code: int, verdict: str, capfd: pytest.CaptureFixture[str]
) -> None:
    options = ["--set", f"law.kind={HERE}:Silent", "--set", f"law.mass={mass}"]
    assert execute(["lab", "certify", *options, "--json"]) == code
    found = json.loads(capfd.readouterr().out)
    assert found == {"holds": code == 0, "verdict": verdict, "decay_rate": 0.5}
    assert execute(["lab", "certify", *options]) == code
    printed = capfd.readouterr().out
    assert verdict in printed
    assert "decay_rate" in printed


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("sliding", "no theorem for this law, sliding"),
        (
            f"{HERE}:Boastful",
            f"the certificate of law {HERE}:Boastful is none: verdict: Field required",
        ),
        (f"{HERE}:Careless", f"no certificate: law {HERE}:Careless: KeyError: 'decay' (test_any_law.py, line "),
    ],
)
def test_without_a_certificate_one_line_says_why(kind: str, line: str) -> None:
    with pytest.raises(NoTheoremError) as error:
        certificate_of(load(overrides=[f"law.kind={kind}"]))
    assert str(error.value).startswith(line)


def test_an_own_certificate_keeps_what_the_law_says() -> None:
    found = certificate_of(load(overrides=[f"law.kind={HERE}:Silent"]))
    assert isinstance(found, CustomCertificate)
    assert found.model_extra == {"decay_rate": 0.5}


def test_a_description_carries_what_certify_prints_or_nothing() -> None:
    assert described_certificate(load()) == certify(load()).model_dump(mode="json")
    for without in ("reference.kind=stream", "law.kind=sliding"):
        assert described_certificate(load(overrides=[without])) is None
