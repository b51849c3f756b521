"""`lab laws`: control laws beside each other, tuned alike: what is proven, measured and survived of each.

A law that is not the configured one has the gains of the tuning rule, from the bandwidth and damping ratio of the
configured C₁ and C₂; a law of one's own has its defaults. A law that adapts stands beside itself with all adaptation
gains 0. Everything else is the same for all of them. Each runs calm and in wind, with several seeds, and sends on
change, so that a law that chatters pays in bits. What a law survives is searched calm (`margins.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter
from statistics import fmean, stdev
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.wire.spec import SignalBits
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.baselines import TUNED, NonadaptiveSettings, Response, response_of, tuned
from aeroloop.service.control.laws.interface import EstimateSettings, PythonLaw
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.lab.engine import PROCESSES, Progress, Row, Sheets, cell, figures_row, open_workers, run_of
from aeroloop.service.lab.margins import LONGEST_S, WITHIN_DEG, survived
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.extremes import BoundlessError
from aeroloop.service.theorem.premises import NoTheoremError

# ── what is compared ──

_OFF: Final = [0.0, 0.0, 0.0]
WITHOUT_ADAPTATION: Final[dict[str, dict[str, Any]]] = {
    "adaptive": {"kind": "nonadaptive"},  # the same law with θ̂ as first estimated; its own Γ cannot be 0
    "adaptive-torque": {"Gamma_torque": _OFF, "Gamma_damping": _OFF, "Gamma_coulomb": _OFF},
}
"""Settings that take the adaptation from a law."""
_NO_GAMMA: Final = ", Γ = 0"
"""Ends the name of such a law."""
LAWS: Final = ("adaptive", *TUNED)


def compared_laws(settings: Settings, laws: Sequence[str] = ()) -> dict[str, list[str]]:
    """Name of each law, and its overrides: those that are given, else the configured one and `LAWS`.

    A law that adapts is there without its adaptation, too.

    Raises:
        ConfigError, PluginError, LawError: There is no such law, or it cannot have these settings.
    """
    kinds = dict.fromkeys(laws or (settings.law.kind, *LAWS))
    names = [name for kind in kinds for name in (kind, kind + _NO_GAMMA)[: 1 + (kind in WITHOUT_ADAPTATION)]]
    sending = {"transmit": {"measurement": "on_change", "command": "on_change"}}
    found = {name: as_overrides({"wire": sending, "law": _law(settings, name)}) for name in names}
    for overrides in found.values():
        with_law_settings(load_over(settings, overrides))
    return found


def laws_in_python(settings: Settings, laws: Mapping[str, Sequence[str]]) -> list[str]:
    """Names of those laws that are plain Python, and so run tick by tick."""
    classes = {name: law_class(load_over(settings, overrides).law) for name, overrides in laws.items()}
    return [name for name, law in classes.items() if issubclass(law, PythonLaw)]


def _law(settings: Settings, name: str) -> dict[str, Any]:
    """What `[law]` of a law of this name has over the configuration's."""
    law, kind = settings.law, name.removesuffix(_NO_GAMMA)
    off = WITHOUT_ADAPTATION[kind] if kind != name else {}
    if (kind := off.get("kind", kind)) == law.kind:
        return off
    section = dict[str, Any]()
    if kind in (*LAWS, "nonadaptive") and isinstance(law, EstimateSettings):  # what is known of the body's damping
        section |= {"damping_estimate": law.damping_estimate, "damping_bound": law.damping_bound}
    if kind in ("adaptive", "nonadaptive") and isinstance(law, AdaptiveSettings | NonadaptiveSettings):
        section |= {"C1": law.C1, "C2": law.C2}
    return {"kind": kind, **section, **tuned(kind, law, _response(settings)), **off}


def _response(settings: Settings) -> Response:
    """The response that the configured gains of the paper's law give; those of Table C.1, if it has none."""
    law = settings.law
    gains = law if isinstance(law, AdaptiveSettings | NonadaptiveSettings) else AdaptiveSettings()
    return response_of(law.inertia, gains.C1, gains.C2)


# ── the comparison ──

_MEANS: Final = ("z_track", "u_total", "command_changes_per_s")
_WORST: Final = ("max_error_deg", "second_half_error_deg")


class Laws(BaseModel):
    """The comparison.

    A row has the law and its wind; pointwise_deg, the bound of its certificate, null of a law without a theorem;
    delay_ms and lost_frames, what it survives, calm; figures by the names of `Figures` (means over the seeds, and the
    largest errors of any); spread, standard deviations of the means over the seeds, null for one seed; bits_per_s of
    both directions, sent on change; and reason, why there are no figures: then all of them are None.
    """

    model_config = ConfigDict(frozen=True)

    duration_s: float
    seeds: int
    bits: str = Field(description="of ε, ω and u")
    bandwidth: list[float] = Field(description="ωₙ of the linearised attitude error of each axis, of all laws [rad/s]")
    damping_ratio: list[float] = Field(description="ζ of the same [1]")
    within_deg: float = Field(default=WITHIN_DEG, description="bound of the error, for what is survived [deg]")
    margin_duration_s: float = Field(description="length of a run with delay or lost frames [s]")
    gains: dict[str, dict[str, Any]] = Field(description="settings of each law")
    rows: list[Row]


def compare(
    settings: Settings,
    laws: Mapping[str, Sequence[str]],
    *,
    seeds: int = 1,
    duration_s: float,
    engine: str = PROCESSES,
    progress: Progress = lambda _done, _total: None,
) -> Laws:
    """Run laws, as of `compared_laws`, each calm and in wind with so many seeds, by an engine as of `open_workers`.

    Where the plant is not emulated, a law runs in its own wind alone.
    """
    winds: dict[str, list[str]] = {"its own": []}
    if settings.plant.emulated:
        winds = {"calm": ["plant.wind.blowing=false"], "wind": ["plant.wind.blowing=true"]}
    choices = [(name, wind) for name in laws for wind in winds]
    runs = [run_of(settings, [*laws[name], *winds[w]], seed) for name, w in choices for seed in range(seeds)]
    searches = [run_of(settings, [*overrides, *next(iter(winds.values()))]) for overrides in laws.values()]
    total = len(runs) + len(searches)
    with open_workers(engine) as workers:
        rows = workers.rows(partial(figures_row, duration_s=duration_s), runs, lambda n: progress(n, total))
        survive = partial(survived, duration_s=duration_s)
        margins = workers.rows(survive, searches, lambda n: progress(len(runs) + n, total))
    configured = {name: with_law_settings(load_over(settings, overrides)) for name, overrides in laws.items()}
    of_law = {n: {"pointwise_deg": _proven(configured[n]), **margin} for n, margin in zip(laws, margins, strict=True)}
    response, wire = _response(settings), settings.wire
    bits = SignalBits(wire.attitude.bits, wire.rate.bits, wire.voltage.bits)
    return Laws(
        duration_s=duration_s, seeds=seeds, bits=str(bits), margin_duration_s=min(duration_s, LONGEST_S),
        bandwidth=list(response.bandwidth), damping_ratio=list(response.damping),
        gains={name: each.description()["law"] for name, each in configured.items()},
        rows=[
            {"law": name, "wind": wind, **of_law[name], **_over_seeds(rows[i * seeds : (i + 1) * seeds])}
            for i, (name, wind) in enumerate(choices)
        ],
    )  # fmt: skip


def _proven(settings: Settings) -> float | None:
    """The bound of the attitude error [deg]; None without a theorem or a bound."""
    try:
        return certify(settings, margins=False).pointwise_deg
    except (NoTheoremError, BoundlessError):
        return None


def _over_seeds(rows: Sequence[Row]) -> Row:
    """Figures of a law in a wind, of those of its seeds."""
    if reasons := [row["reason"] for row in rows if row["reason"] is not None]:
        several = f"{len(reasons)} of {len(rows)} seeds: " if len(rows) > 1 else ""
        return {**dict.fromkeys((*_MEANS, *_WORST, "bits_per_s", "spread")), "reason": f"{several}{reasons[0]}"}
    return {
        **{name: fmean(row[name] for row in rows) for name in _MEANS},
        **{name: max(row[name] for row in rows) for name in _WORST},
        "bits_per_s": fmean(row["measurement_bits_per_s"] + row["command_bits_per_s"] for row in rows),
        "spread": {name: stdev(row[name] for row in rows) for name in _MEANS} if len(rows) > 1 else None,
        "reason": None,
    }


def sheets(laws: Laws) -> Sheets:
    """A line a law, of two figures the first calm, the second in wind."""
    lines = []
    for law, each in groupby(laws.rows, itemgetter("law")):
        winds = list(each)

        def both(name: str, form: str, scale: float = 1, rows: Sequence[Row] = winds) -> str:
            return "; ".join(cell(row[name], form, scale) for row in rows)

        lines.append(
            {
                "law": law,
                "bound": cell(winds[0]["pointwise_deg"], "{:.2f}°"),
                "z_track 10⁻⁴ s": both("z_track", "{:.1f}", 1e4),
                "u_total V²·s": both("u_total", "{:.0f}"),
                "settled": both("second_half_error_deg", "{:.2f}°"),
                "changes/s": both("command_changes_per_s", "{:.0f}"),
                "kbit/s": both("bits_per_s", "{:.1f}", 1e-3),
                "delay": cell(winds[0]["delay_ms"], "{:g} ms", missing="none"),
                "frames lost in a row": cell(winds[0]["lost_frames"], "{}", missing="none"),
            }
        )
    yield f"{laws.bits} bits · {'; '.join(dict.fromkeys(row['wind'] for row in laws.rows))}", lines
    failed = [f"{row['law']}, {row['wind']}: {row['reason']}" for row in laws.rows if row["reason"] is not None]
    if failed:
        yield "\n".join(failed), []
    bandwidth, damping = (
        "/".join(dict.fromkeys(f"{value:.2f}" for value in values)) for values in (laws.bandwidth, laws.damping_ratio)
    )
    seeds = f"means of seeds 0 to {laws.seeds - 1}" if laws.seeds > 1 else "seed 0"
    yield (
        f"Tuned to ωₙ = {bandwidth} rad/s and ζ = {damping} of the linearised error, which the paper's gains have "
        "(service/control/laws/README.md has the rule); a law of your own, and the configured one, as configured. "
        "Γ = 0: the same law without adaptation. Bound: proven of the error at every instant, in the end, for the "
        "paper's body; – without a theorem, or without a set.",
        [],
    )
    yield (
        f"{laws.duration_s:g} s each, {seeds}, sent on change. Settled is the largest error of the second half, of any "
        f"seed. Survived with an error within {laws.within_deg:g}°, calm, for {laws.margin_duration_s:g} s, without a "
        "watchdog: commands that act later, or of which so many in a row never do, again and again, up to 1 s.",
        [],
    )
