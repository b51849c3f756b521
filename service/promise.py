"""What the theorem promises of a configuration, for the contract of the controller that runs it."""

from __future__ import annotations

from typing import Any

from service.certificate import Certificate, certify
from service.config import Settings
from service.extremes import BoundlessError


def promise_of(settings: Settings) -> dict[str, Any] | None:
    """The certificate as data; None for a reference without bounds, of which nothing can be promised."""
    try:
        certificate = certify(settings.wire, settings.law, settings.reference, settings.controller)
    except BoundlessError:
        return None
    return certificate.model_dump(mode="json")


def verdict_of(promise: dict[str, Any]) -> str:
    """What a contract's certificate says, in a sentence."""
    return Certificate.model_validate(promise).verdict
