"""Registry of laws: `[law]` of the configuration, the law that it names, and one tick of it as a function."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import nan
from typing import TYPE_CHECKING, Annotated, Any, Final, Union

import casadi as ca
import numpy as np
from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationError, create_model

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Gains
from aeroloop.protocol.plugins import PluginError, exception_line, find, place_of, source_of
from aeroloop.protocol.wire.attitude import R, S
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wording import problems
from aeroloop.service.control.laws.adaptive import Adaptive
from aeroloop.service.control.laws.adaptive_torque import AdaptiveTorque
from aeroloop.service.control.laws.baselines import LQR, PD, PID, Nonadaptive, Sliding
from aeroloop.service.control.laws.interface import ExpressionLaw, Law, LawSettings, Now, PythonLaw

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


class UnknownLawSettings(CustomLawSettings):
    """Settings of a log's law that cannot be had here: `UnknownLaw` stands for it."""


class UnknownLaw(PythonLaw[UnknownLawSettings]):
    """Stands for a law that cannot be had: no gains, no state and no voltages are known of it."""

    Settings = UnknownLawSettings

    def reset(self) -> None:
        """Its state is not known."""
        self.state = {}

    def step(self, now: Now[Any]) -> list[float]:  # noqa: ARG002  # the law's argument
        """Its voltages are not known."""
        return [nan] * self.actuators


def no_such_gain(kind: str, name: str, numbers: int) -> LawError:
    """The error of a gain that a law of this kind does not have."""
    return LawError(f"law {kind} has no gain {name} of {numbers} number{'' if numbers == 1 else 's'}")


def law_class(section: LawSettings) -> type[Law[Any]]:
    """The class of the law that a section configures. Raises PluginError."""
    if isinstance(section, UnknownLawSettings):
        return UnknownLaw
    return find("law.kind", section.kind, BUILT_IN, Law)


def law_settings(section: LawSettings) -> LawSettings:
    """The settings as the law's own model has them, defaults included. Raises PluginError, or LawError if wrong."""
    law = law_class(section)
    model = getattr(law, "Settings", None)
    if not (isinstance(model, type) and issubclass(model, LawSettings)):
        why = f"has no Settings that derive from aeroloop.LawSettings{place_of(law)}"
        raise PluginError(f"law.kind = {section.kind!r} {why}")
    return section if isinstance(section, model) else _valid(model, section.model_dump())


def law_of(section: LawSettings, period: float, actuators: int) -> Law[Any]:
    """The law that a section configures, for ticks of a period [s].

    Raises PluginError if there is none, LawError if the settings are wrong or it is no law for so many actuators.
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
    """The settings with other gains; those not given stay. Raises LawError if one is unknown or out of its bounds."""
    law, settings = law_class(section), law_settings(section)
    if unknown := [name for name in gains.named if name not in law.gains]:
        known = ", ".join(law.gains) or "none that may change while it runs"
        raise LawError(f"law {section.kind} has no gain {unknown[0]}; it has {known}")
    changed: dict[str, Any] = dict(gains.named)
    for name, gain in gains.named.items():
        present = getattr(settings, name)
        size = len(present) if isinstance(present, Sequence) else 1
        if len(gain) != size:
            numbers = "number" if size == 1 else "numbers"
            raise LawError(f"law.{name} is {size} {numbers}, such as {_as_typed(present)}, not {_as_typed(gain)}")
        if not isinstance(present, Sequence):
            changed[name] = gain[0]
    return _valid(type(settings), settings.model_dump() | changed)


def _as_typed(gain: float | Sequence[float]) -> str:
    values = gain if isinstance(gain, Sequence) else [gain]
    return " ".join(f"{value:g}" for value in values)


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
    return str(error) if kind in BUILT_IN else f"law {kind}: {exception_line(error, called)}"


def no_number(law: Law[Any]) -> str:
    """That a law gave NaN or infinity, in one line, with file and line of a user's."""
    kind = law.settings.kind
    called = law.step if isinstance(law, PythonLaw) else getattr(law, "expressions", None)
    return f"law {kind} gave no number" + ("" if kind in BUILT_IN else place_of(called))


# ── one tick of a law as a function ──


def received(eps: ca.SX, last: ca.SX) -> ca.SX:
    """q^Q of a received ε: `aeroloop.protocol.wire.attitude.received_quaternion`, as an expression. Shape (4,).

    Of ±q the one nearer to the previous q^Q is taken, `last`.
    """
    square = ca.dot(eps, eps)
    eta = ca.sqrt(ca.fmax(0, 1 - square))  # (C.11)
    q = ca.vertcat(eta, eps / ca.sqrt(ca.fmax(1, square)))  # Remark 2
    return q * (1 - 2 * (ca.dot(q, last) < 0))


def tracking_errors(q: ca.SX, omega: ca.SX, q_d: ca.SX, omega_d: ca.SX) -> tuple[ca.SX, ca.SX]:
    """e of (C.16), (C.32) and ω_e of (C.18), (C.47). Shapes (4,) and (3,)."""
    eta, eps, eta_d, eps_d = q[0], q[1:4], q_d[0], q_d[1:4]
    eta_e = eta_d * eta + ca.dot(eps_d, eps)
    eps_e = eta_d * eps - eta * eps_d - S(eps_d) @ eps
    return ca.vertcat(eta_e, eps_e), omega - R(q).T @ omega_d


_INPUTS: Final = ("last", "state", "gains", "eps", "omega", "q_d", "omega_d", "omega_d_dot")


def law_function(law: Law[Any]) -> ca.Function:
    """One tick of a law. Raises LawError if it fails, gives other voltages, or another state than its first one.

    Inputs: last (the previous q), state, gains, and eps, omega, q_d, omega_d, omega_d_dot. The named states stand one
    below the other, as do the gains. Of a law in Python also law_voltages and law_state, which it has computed.
    Outputs: q, u, state_next, eta_e, eps_e, omega_e.
    """
    states = {name: len(value) for name, value in initial_state(law).items()}
    gains = {name: len(value) for name, value in configured_gains(law).items()}
    sizes = dict(zip(_INPUTS, (4, sum(states.values()), sum(gains.values()), 3, 3, 4, 3, 3), strict=True))
    given = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
    last, state, gain, eps, omega, q_d, omega_d, omega_d_dot = given.values()
    q, e, omega_e = ca.SX.sym("q", 4), ca.SX.sym("e", 4), ca.SX.sym("omega_e", 3)
    attitude = ca.Function("attitude", [last, eps], [received(eps, last)])
    moving = [q, omega, q_d, omega_d]
    errors = ca.Function("errors", moving, list(tracking_errors(*moving)), {"cse": True})
    if isinstance(law, ExpressionLaw):
        now = Now(q, omega, q_d, omega_d, omega_d_dot, e, omega_e, _split(gain, gains), _split(state, states))
        seen = [state, q, omega, q_d, omega_d, omega_d_dot, e, omega_e, gain]
        with naming(law.settings.kind, law.expressions):
            answer = ca.Function("answer", seen, _answer(law, now, states), {"cse": True})
    else:
        of_law = ca.SX.sym("law_voltages", law.actuators), ca.SX.sym("law_state", sizes["state"])
        given |= dict(zip(("law_voltages", "law_state"), of_law, strict=True))
    with as_written():
        q = attitude(last, eps)
        e, omega_e = errors(q, omega, q_d, omega_d)
        seen = [state, q, omega, q_d, omega_d, omega_d_dot, e, omega_e, gain]
        u, after = answer(*seen) if isinstance(law, ExpressionLaw) else of_law
        found = {"q": q, "u": u, "state_next": after, "eta_e": e[0], "eps_e": e[1:4], "omega_e": omega_e}
        # The parts overlap, and a law may compute the errors once more, as the paper has them.
        return ca.Function("law", [*given.values()], [*found.values()], [*given], [*found], {"cse": True})


def _answer(law: ExpressionLaw[Any], now: Now[ca.SX], first: Mapping[str, int]) -> list[ca.SX]:
    """Voltages and next state of a law, each in one column; `first` has the sizes of its first state."""
    answer = law.expressions(now)
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise TypeError("it gives one value, not two: the voltages, and the state after this tick, such as {}")
    u = ca.densify(ca.vec(ca.SX(answer[0])))
    after = {name: ca.vec(ca.SX(value)) for name, value in answer[1].items()}
    check_answer(law, u.numel(), {name: value.numel() for name, value in after.items()}, first)
    return [u, ca.densify(ca.vertcat(ca.SX(0, 1), *(after[name] for name in first)))]


def _split(column: ca.SX, sizes: Mapping[str, int]) -> dict[str, ca.SX]:
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {name: column[ends[i] : ends[i + 1]] for i, name in enumerate(sizes)}


def check_answer(law: Law[Any], voltages: int, after: Mapping[str, int], first: Mapping[str, int]) -> None:
    """Raise ValueError if a law gives other than one voltage for each actuator, or another state than its first one.

    `after` and `first` have the sizes of both states, by name.
    """
    if voltages != law.actuators:
        raise ValueError(f"it gives {voltages} voltages for {law.actuators} actuators")
    if dict(after) != dict(first):
        found, known = (", ".join(f"{n} of {size}" for n, size in sizes.items()) or "none" for sizes in (after, first))
        raise ValueError(f"its state after a tick is {found}, and its first state is {known}")


def configured_gains(law: Law[Any]) -> dict[str, tuple[float, ...]]:
    """The gains of a law's settings, by name. Raises LawError for a gain that its settings do not have."""
    with naming(law.settings.kind, type(law)):
        values = {name: getattr(law.settings, name) for name in law.gains}
    return {name: tuple(value) if isinstance(value, Sequence) else (value,) for name, value in values.items()}


def initial_state(law: Law[Any]) -> dict[str, list[float]]:
    """The named state before the first tick. Raises LawError if the law fails."""
    if isinstance(law, PythonLaw):
        with naming(law.settings.kind, law.reset):
            law.state = {}
            law.reset()
            return {name: np.asarray(values, dtype=np.float64).ravel().tolist() for name, values in law.state.items()}
    assert isinstance(law, ExpressionLaw)
    with naming(law.settings.kind, law.initial):
        return {name: list(map(float, values)) for name, values in law.initial().items()}
