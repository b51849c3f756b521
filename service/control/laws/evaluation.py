"""Evaluation of a law at one tick: the attitude as received, the errors, and the law's expressions as one function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.rotations import R, S
from aeroloop.protocol.wire.symbolic import along_rows, in_columns
from aeroloop.service.control.laws.interface import ExpressionLaw, Law, Now, PythonLaw


def received(eps: ca.SX, last: ca.SX) -> ca.SX:
    """q^Q of ε as received: `aeroloop.protocol.wire.attitude.received_quaternion`, as an expression. Shape (4,).

    Args:
        eps: ε. Shape (3,).
        last: The previous q^Q; of ±q the nearer one is taken. Shape (4,).
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


def law_function(law: ExpressionLaw[Any]) -> ca.Function:
    """One tick of a law of expressions.

    Inputs: last (the previous q), state, gains, and eps, omega, q_d, omega_d, omega_d_dot. The named states stand one
    below the other, as do the gains.
    Outputs: q, u, state_next, eta_e, eps_e, omega_e.

    Raises:
        ValueError: The law gives another number of voltages, or another state than its first one.
    """
    parts = _parts(law)
    given = {name: ca.SX.sym(name, parts.sizes[name]) for name in INPUTS}
    last, state, gains, eps, *motion = given.values()
    with as_written():
        q = parts.attitude(last, eps)
        e, omega_e = parts.errors(q, *motion[:3])
        seen = q, *motion, e, omega_e, gains
        return ca.Function(
            "law",
            [*given.values()],
            [q, parts.voltages(state, *seen), parts.state(state, *seen), e[0], e[1:4], omega_e],
            [*given],
            ["q", "u", "state_next", "eta_e", "eps_e", "omega_e"],
            {"cse": True},  # the parts overlap, and a law may compute the errors once more, as the paper has them
        )


def law_of_many(law: ExpressionLaw[Any], rows: int) -> ca.Function:
    """Many consecutive ticks of a law of expressions, for readers of logs. Raises as `law_function` does.

    Attitude and state go from row to row; all else is computed in columns (protocol/wire/symbolic.py).

    Args:
        law: The law.
        rows: How many ticks; a multiple of `aeroloop.protocol.wire.symbolic.UNROLLED`.

    Returns:
        A function with the inputs of `law_function`: `last` and `state` are those before the first tick, all others
        have a row per tick. Its outputs: q, u, state_next, eps_e, omega_e, and state_used, from which u was computed.
    """
    parts = _parts(law)
    given = {
        name: ca.MX.sym(name, *((n, 1) if name in ("last", "state") else (rows, n))) for name, n in parts.sizes.items()
    }
    last, first, gains, eps, *motion = (given[name] for name in INPUTS)
    q = along_rows(parts.attitude, last, eps)
    e, omega_e = in_columns(parts.errors, rows)(q, *motion[:3])
    seen = q, *motion, e, omega_e, gains
    after = along_rows(parts.state, first, *seen) if parts.sizes["state"] else ca.MX(rows, 0)
    state = ca.vertcat(first.T, after[:-1, :]) if parts.sizes["state"] else ca.MX(rows, 0)
    u = in_columns(parts.voltages, rows)(state, *seen)
    return ca.Function(
        "law_of_many",
        [given[name] for name in INPUTS],
        [q, u, after, e[:, 1:4], omega_e, state],
        list(INPUTS),
        ["q", "u", "state_next", "eps_e", "omega_e", "state_used"],
    )


INPUTS: Final = ("last", "state", "gains", "eps", "omega", "q_d", "omega_d", "omega_d_dot")


class _Parts(NamedTuple):
    """A tick in parts.

    Attributes:
        attitude: last, eps ↦ q.
        errors: q, omega, q_d, omega_d ↦ e, omega_e.
        state: state, q, omega, q_d, omega_d, omega_d_dot, e, omega_e, gains ↦ state after.
        voltages: The same ↦ u.
        sizes: Of INPUTS, by name.
    """

    attitude: ca.Function
    errors: ca.Function
    state: ca.Function
    voltages: ca.Function
    sizes: dict[str, int]


def _parts(law: ExpressionLaw[Any]) -> _Parts:
    states = {name: len(value) for name, value in law.initial().items()}
    gain_sizes = {name: len(value) for name, value in configured_gains(law).items()}
    sizes = dict(zip(INPUTS, (4, sum(states.values()), sum(gain_sizes.values()), 3, 3, 4, 3, 3), strict=True))
    last, state, gains, eps, omega, q_d, omega_d, omega_d_dot = (ca.SX.sym(name, n) for name, n in sizes.items())
    q, e, omega_e = ca.SX.sym("q", 4), ca.SX.sym("e", 4), ca.SX.sym("omega_e", 3)
    now = Now(q, omega, q_d, omega_d, omega_d_dot, e, omega_e, split(gains, gain_sizes), split(state, states))
    voltages, after = law.expressions(now)
    u = ca.densify(ca.vec(ca.SX(voltages)))
    check_voltages(law, u.numel())
    found = {name: ca.vec(ca.SX(value)) for name, value in after.items()}
    if {name: value.numel() for name, value in found.items()} != states:
        raise ValueError(f"its state after a tick is not that of `initial`: {', '.join(states) or 'none'}")
    state_after = ca.densify(ca.vertcat(ca.SX(0, 1), *(found[name] for name in states)))
    seen = [state, q, omega, q_d, omega_d, omega_d_dot, e, omega_e, gains]
    errors = list(tracking_errors(q, omega, q_d, omega_d))
    return _Parts(
        ca.Function("attitude", [last, eps], [received(eps, last)], ["last", "eps"], ["q"]),
        ca.Function("errors", [q, omega, q_d, omega_d], errors, {"cse": True}),
        ca.Function("state", seen, [state_after], {"cse": True}),
        ca.Function("voltages", seen, [u], {"cse": True}),
        sizes,
    )


def python_law_function(law: Law[Any]) -> ca.Function:
    """One tick around a law in Python, as `law_function`.

    What the law has computed are two more inputs, law_voltages and law_state: they are u and state_next.
    """
    states, gains = sum(map(len, initial_state(law).values())), sum(map(len, configured_gains(law).values()))
    sizes = dict(zip(INPUTS, (4, states, gains, 3, 3, 4, 3, 3), strict=True))
    given = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
    u, after = ca.SX.sym("law_voltages", law.actuators), ca.SX.sym("law_state", states)
    q, (eps, omega, q_d, omega_d) = ca.SX.sym("q", 4), (given[name] for name in ("eps", "omega", "q_d", "omega_d"))
    attitude = ca.Function("attitude", [given["last"], eps], [received(eps, given["last"])])
    errors = ca.Function("errors", [q, omega, q_d, omega_d], tracking_errors(q, omega, q_d, omega_d))
    with as_written():
        q = attitude(given["last"], eps)
        e, omega_e = errors(q, omega, q_d, omega_d)
        return ca.Function(
            "law",
            [*given.values(), u, after],
            [q, u, after, e[0], e[1:4], omega_e],
            [*given, "law_voltages", "law_state"],
            ["q", "u", "state_next", "eta_e", "eps_e", "omega_e"],
            {"cse": True},
        )


def check_voltages(law: Law[Any], voltages: int) -> None:
    """Raise ValueError if a law gives another number of voltages than there are actuators."""
    if voltages != law.actuators:
        raise ValueError(f"it gives {voltages} voltages for {law.actuators} actuators")


def configured_gains(law: Law[Any]) -> dict[str, tuple[float, ...]]:
    """The gains of a law's settings, by name."""
    values = {name: getattr(law.settings, name) for name in law.gains}
    return {name: tuple(value) if isinstance(value, Sequence) else (value,) for name, value in values.items()}


def initial_state(law: Law[Any]) -> dict[str, list[float]]:
    """The named state before the first tick."""
    if isinstance(law, PythonLaw):
        law.state = {}
        law.reset()
        return {name: np.asarray(values, dtype=np.float64).ravel().tolist() for name, values in law.state.items()}
    assert isinstance(law, ExpressionLaw)
    return {name: list(map(float, values)) for name, values in law.initial().items()}


def split(column: ca.SX, sizes: Mapping[str, int]) -> dict[str, ca.SX]:
    """Consecutive parts of a column, by name."""
    ends = [0]
    for size in sizes.values():
        ends.append(ends[-1] + size)
    return {name: column[ends[i] : ends[i + 1]] for i, name in enumerate(sizes)}
