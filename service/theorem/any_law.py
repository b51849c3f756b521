"""Certificate of any law: the paper's theorem for the paper's law, and for another what that law says is proven."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.protocol.wording import problem
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import law_class, words_of
from aeroloop.service.theorem.certificate import Certificate, Evaluated, certify, evaluate
from aeroloop.service.theorem.extremes import BoundlessError
from aeroloop.service.theorem.feedback import NoTheoremError


class OwnCertificate(BaseModel):
    """What a user's law says is proven of a configuration: `Law.certify`. It may have more than these."""

    model_config = ConfigDict(extra="allow", frozen=True)

    holds: bool
    verdict: str


def certify_any(settings: Settings, **options: Any) -> Certificate | OwnCertificate:
    """The certificate of a configuration, whatever its law.

    Args:
        settings: The configuration.
        options: As `certify` takes them, for the paper's law.

    Raises:
        NoTheoremError: The law has none, or its own `certify` fails; one line that names it.
        BoundlessError: The reference has no bounds.
        PluginError: There is no such law.
    """
    law, kind = law_class(settings.law), settings.law.kind
    try:
        own = law.certify(settings)
        if own is not None:
            return OwnCertificate.model_validate(own)
    except ValidationError as error:
        raise NoTheoremError(f"the certificate of law {kind} is none: {problem(error, OwnCertificate)}") from None
    except Exception as error:
        raise NoTheoremError(f"no certificate: {words_of(kind, error, law.certify)}") from None
    return certify(settings, **options)


def described_certificate(settings: Settings) -> dict[str, Any] | None:
    """The certificate as a controller's description carries it; None of a stream, or of a law without a theorem."""
    try:
        return certify_any(settings).model_dump(mode="json")
    except (NoTheoremError, BoundlessError):
        return None


class Promise(NamedTuple):
    """The law with the gains in force, its certificate, what that is made of, and the verdict in a sentence.

    Of a law without a theorem, or a reference without bounds, only the law and the verdict are known.
    """

    law: LawSettings
    certificate: Certificate | None
    bounds: Evaluated | None
    verdict: str


def promise(settings: Settings, changes: Sequence[Change] = (), described: Mapping[str, Any] | None = None) -> Promise:
    """What is promised with these changes of gains and reference in force.

    `described` is the certificate in the controller's description: it counts if both are as configured.
    """
    law, reference = settings.law, settings.reference
    for change in in_force(changes):
        reference = change.reference or reference
        if change.gains is not None:
            law = law.model_copy(update=change.gains.named)
    begun = settings.model_copy(update={"law": law, "reference": reference})
    try:
        bounds = evaluate(begun)
    except NoTheoremError as error:
        text = str(error)
        return Promise(law, None, None, (described or {}).get("verdict", f"{text[0].upper()}{text[1:]}."))
    except BoundlessError as error:
        return Promise(law, None, None, f"Nothing is promised: {error}.")
    certificate = None
    if (law, reference) == (settings.law, settings.reference) and described is not None:
        with suppress(ValidationError):  # of another version
            certificate = Certificate.model_validate(described)
    certificate = certificate or certify(begun)
    return Promise(law, certificate, bounds, certificate.verdict)
