"""Certificate of any law: the paper's theorem for the paper's law, and for another what that law says is proven."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from aeroloop.protocol.wording import problem
from aeroloop.service.control.laws.registry import law_class, words_of
from aeroloop.service.theorem.certificate import Certificate, certify
from aeroloop.service.theorem.configured import NoTheoremError, Sections
from aeroloop.service.theorem.extremes import BoundlessError


class OwnCertificate(BaseModel):
    """What a user's law says is proven of a configuration: `Law.certify`. It may have more than these."""

    model_config = ConfigDict(extra="allow", frozen=True)

    holds: bool
    verdict: str


def certify_any(settings: Sections, **options: Any) -> Certificate | OwnCertificate:
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
        raise NoTheoremError(f"no certificate: {words_of(kind, error)}") from None
    return certify(settings, **options)


def described_certificate(settings: Sections) -> dict[str, Any] | None:
    """The certificate as a controller's description carries it; None of a stream, or of a law without a theorem."""
    try:
        return certify_any(settings).model_dump(mode="json")
    except (NoTheoremError, BoundlessError):
        return None
