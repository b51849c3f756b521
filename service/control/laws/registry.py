"""Registry of laws: `[law]` of the configuration, and the law that it names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Final, Union

from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationError, create_model

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Gains
from aeroloop.protocol.plugins import PluginError, exception_line, find, place_of, source_of
from aeroloop.protocol.wording import problems
from aeroloop.service.control.laws.adaptive import Adaptive
from aeroloop.service.control.laws.adaptive_torque import AdaptiveTorque
from aeroloop.service.control.laws.baselines import LQR, PD, PID, Nonadaptive, Sliding
from aeroloop.service.control.laws.interface import Law, LawSettings, PythonLaw

_OURS: Final[tuple[type[Law[Any]], ...]] = Adaptive, Nonadaptive, PD, PID, AdaptiveTorque, Sliding, LQR
_OWN: Final = "package.module:Class"


class CustomLawSettings(LawSettings):
    """A user's law, as configured. Its own model checks the keys where the law is used: `law_settings`."""

    model_config = ConfigDict(extra="allow")


BUILT_IN: Final = {law.Settings.model_fields["kind"].default: f"{law.__module__}:{law.__name__}" for law in _OURS}
MODELS: Final = dict(zip(BUILT_IN, (law.Settings for law in _OURS), strict=True)) | {_OWN: CustomLawSettings}
"""The model of each kind of `[law]`."""


def _tag(section: Any) -> str:
    kind = section.get("kind", "adaptive") if isinstance(section, dict) else getattr(section, "kind", "")
    return kind if isinstance(kind, str) and kind in BUILT_IN else _OWN


_MAPPING: Final = {kind: f"#/$defs/{model.__name__}" for kind, model in MODELS.items()}
if TYPE_CHECKING:
    LawSection = LawSettings
else:
    LawSection = Annotated[
        Union[tuple(Annotated[model, Tag(kind)] for kind, model in MODELS.items())],  # noqa: UP007  # of a table
        Discriminator(_tag),
        Field(json_schema_extra={"discriminator": {"propertyName": "kind", "mapping": _MAPPING}}),
    ]
    """`[law]`: the model of the kind that it names."""


class LawError(AeroloopError):
    """A law that cannot be used; one line with its name."""


def law_class(section: LawSettings) -> type[Law[Any]]:
    """The class of the law that a section configures. Raises PluginError."""
    return find("law.kind", section.kind, BUILT_IN, Law)


def law_settings(section: LawSettings) -> LawSettings:
    """The settings as the law's own model has them, defaults included. Raises PluginError, or LawError if wrong."""
    law = law_class(section)
    model = getattr(law, "Settings", None)
    if not (isinstance(model, type) and issubclass(model, LawSettings)):
        raise PluginError(
            f"law.kind = {section.kind!r} has no Settings that derive from aeroloop.LawSettings{place_of(law)}"
        )
    return section if isinstance(section, model) else _valid(model, section.model_dump())


def law_of(section: LawSettings, period: float, actuators: int) -> Law[Any]:
    """The law that a section configures, for ticks of a period [s].

    Raises:
        PluginError: There is no such law.
        LawError: The settings are wrong, or it is no law for so many actuators.
    """
    law, settings = law_class(section), law_settings(section)
    with naming(section.kind, law):
        return law(settings, period, actuators)


def version_of(section: LawSettings) -> dict[str, str]:
    """Which source a user's law is of, for descriptions; nothing of ours. Raises PluginError."""
    return {} if section.kind in BUILT_IN else {f"law {section.kind}": source_of(law_class(section))}


def gains_of(section: LawSettings) -> Gains:
    """The configured gains. Raises as `law_settings`."""
    settings = law_settings(section)
    return Gains.model_validate({name: getattr(settings, name) for name in law_class(section).gains})


def with_gains(section: LawSettings, gains: Gains) -> LawSettings:
    """The settings with other gains; those not given stay.

    Raises:
        PluginError: There is no such law.
        LawError: The law has no such gain, or it is out of its bounds; the text names all of its gains.
    """
    law, settings = law_class(section), law_settings(section)
    if unknown := [name for name in gains.named if name not in law.gains]:
        known = ", ".join(law.gains) or "none that may change while it runs"
        raise LawError(f"law {section.kind} has no gain {unknown[0]}; it has {known}")
    changed: dict[str, Any] = dict(gains.named)
    for name, gain in gains.named.items():
        if len(gain) == 1 and isinstance(getattr(settings, name), int | float):
            changed[name] = gain[0]
    return _valid(type(settings), settings.model_dump() | changed)


def _valid(model: type[LawSettings], values: dict[str, Any]) -> LawSettings:
    configuration: Any = create_model("Configuration", law=(model, ...))  # so that messages have the whole key
    try:
        return configuration.model_validate({"law": values}).law  # type: ignore[no-any-return]  # of `model`
    except ValidationError as error:
        raise LawError("; ".join(problems(error, configuration))) from None


@contextmanager
def naming(kind: str, called: Any) -> Iterator[None]:
    """Raise what the law of this kind raises as LawError; `called` is the function or class of it that runs."""
    try:
        yield
    except Exception as error:  # a user's code may raise anything
        raise LawError(words_of(kind, error, called)) from None


def words_of(kind: str, error: Exception, called: Any) -> str:
    """What a law of this kind raised in one line, with file and line of a user's: there, or where `called` begins."""
    if kind in BUILT_IN:
        return str(error)
    return f"law {kind}: {exception_line(error, called)}"


def no_number(law: Law[Any]) -> str:
    """That a law gave NaN or infinity, in one line, with file and line of a user's."""
    kind = law.settings.kind
    called = law.step if isinstance(law, PythonLaw) else getattr(law, "expressions", None)
    return f"law {kind} gave no number" + ("" if kind in BUILT_IN else place_of(called))
