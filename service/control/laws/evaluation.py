"""One tick of a law as a function: the attitude as received, the errors, and the law's own expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import casadi as ca
import numpy as np

from aeroloop.protocol.wire.attitude import R, S
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.service.control.laws.interface import ExpressionLaw, Law, Now, PythonLaw
from aeroloop.service.control.laws.registry import naming


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
    """One tick of a law.

    Inputs: last (the previous q), state, gains, and eps, omega, q_d, omega_d, omega_d_dot. The named states stand one
    below the other, as do the gains. Of a law in Python also law_voltages and law_state, which it has computed.
    Outputs: q, u, state_next, eta_e, eps_e, omega_e.

    Raises:
        LawError: The law fails, gives another number of voltages, or another state than its first one.
    """
    states = {name: len(value) for name, value in initial_state(law).items()}
    gains = {name: len(value) for name, value in configured_gains(law).items()}
    sizes = dict(zip(_INPUTS, (4, sum(states.values()), sum(gains.values()), 3, 3, 4, 3, 3), strict=True))
    last, state, gain, eps, omega, q_d, omega_d, omega_d_dot = (ca.SX.sym(name, n) for name, n in sizes.items())
    q, e, omega_e = ca.SX.sym("q", 4), ca.SX.sym("e", 4), ca.SX.sym("omega_e", 3)
    attitude = ca.Function("attitude", [last, eps], [received(eps, last)])
    errors = ca.Function(
        "errors", [q, omega, q_d, omega_d], list(tracking_errors(q, omega, q_d, omega_d)), {"cse": True}
    )
    given = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
    if isinstance(law, ExpressionLaw):
        now = Now(q, omega, q_d, omega_d, omega_d_dot, e, omega_e, _split(gain, gains), _split(state, states))
        seen = [state, q, omega, q_d, omega_d, omega_d_dot, e, omega_e, gain]
        with naming(law.settings.kind, law.expressions):
            answer = ca.Function("answer", seen, _answer(law, now, states), {"cse": True})
    else:
        of_law = ca.SX.sym("law_voltages", law.actuators), ca.SX.sym("law_state", sizes["state"])
        given |= dict(zip(("law_voltages", "law_state"), of_law, strict=True))
    last, state, gain, eps, *motion = [given[name] for name in _INPUTS]
    with as_written():
        q = attitude(last, eps)
        e, omega_e = errors(q, *motion[:3])
        u, after = answer(state, q, *motion, e, omega_e, gain) if isinstance(law, ExpressionLaw) else of_law
        return ca.Function(
            "law",
            [*given.values()],
            [q, u, after, e[0], e[1:4], omega_e],
            [*given],
            ["q", "u", "state_next", "eta_e", "eps_e", "omega_e"],
            {"cse": True},  # the parts overlap, and a law may compute the errors once more, as the paper has them
        )


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
