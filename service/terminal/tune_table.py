"""Terminal tables of a search for gains: what it gains in both sets of runs, what it costs, and the gains."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rich.console import Console
from rich.table import Table
from rich.text import Text

from aeroloop.service.lab.tune import Tuning
from aeroloop.service.lab.tune_costs import Summary
from aeroloop.service.lab.tune_search import Gain


def tune_table(tuning: Tuning) -> None:
    """Print a search for gains."""
    console = Console()
    sentence, style = _verdict(tuning)
    console.print(Text(sentence, style=style))
    console.print(
        f"{tuning.experiments} experiments of {tuning.duration_s:g} s with {tuning.candidates} sets of gains of law "
        f"{tuning.law}; seed {tuning.seed}{'; interrupted' if tuning.interrupted else ''}.\n"
    )
    console.print(_figures(tuning))
    console.print()
    console.print(_gains(tuning))
    for line in _notes(tuning):
        console.print(Text(f"\n{line}"), soft_wrap=not console.is_terminal)
    if tuning.overrides:
        console.print()
        for words in tuning.overrides:
            console.print(f"--set '{words}'", markup=False, soft_wrap=True, highlight=False)


def _verdict(tuning: Tuning) -> tuple[str, str]:
    if not tuning.overrides:
        return "No better gains found.", "bold yellow"
    if tuning.worse is not None:
        return f"Not to be used: in the held-out set {tuning.worse}.", "bold red"
    before, after = tuning.before.held_out.cost, tuning.after.held_out.cost
    if not tuning.held_out:
        return "Better gains found, but there is no held-out set: nothing varies with a seed or a wind.", "bold yellow"
    if before is None or after is None:
        return "Better gains found: what tripped in the held-out set trips less.", "bold green"
    return f"Better gains found: in the held-out set the cost changes by {after / before - 1:+.1%}.", "bold green"


def _figures(tuning: Tuning) -> Table:
    table = Table("", box=None, pad_edge=False)
    for name in ("training", "", "held out", "", "limit"):
        table.add_column(name, justify="right")
    table.add_row("", "before", "after", "before", "after", "", style="dim")
    rows: tuple[tuple[str, Callable[[Summary], float | None], Callable[[float], str], float | None], ...] = (
        ("cost, 1e-4 s", lambda s: _times(s.cost, 1e4), "{:.2f}".format, None),
        ("z_track, 1e-4 s", lambda s: _times(s.z_track, 1e4), "{:.2f}".format, None),
        ("u_total, V²·s", lambda s: s.u_total, "{:.0f}".format, None),
        ("error in 2nd half, deg", lambda s: s.settled_deg, "{:.2f}".format, None),
        ("saturated ticks", lambda s: s.saturated, "{:.2%}".format, tuning.limits.saturated),
        ("command changes/s", lambda s: s.changes_per_s, "{:.1f}".format, tuning.limits.changes_per_s),
        ("runs that trip", lambda s: float(s.trips), "{:.0f}".format, None),
    )
    sides = [tuning.before.training, tuning.after.training, tuning.before.held_out, tuning.after.held_out]
    for name, figure, words, limit in rows:
        cells = list[Text]()
        for side in sides:
            value = figure(side)
            over = value is not None and limit is not None and value > limit
            cells.append(Text("–" if value is None else words(value), style="red" if over else ""))
        table.add_row(name, *cells, "" if limit is None else words(limit))
    both = tuning.before, tuning.after
    table.add_row("delay survived, ms", *(_number(side.delay_ms) for side in both), "", "", "")
    table.add_row("frames lost in a row", *(_number(side.lost_frames) for side in both), "", "", "")
    return table


def _gains(tuning: Tuning) -> Table:
    table = Table("gain", "before", "after", box=None, pad_edge=False)
    for name, gain in tuning.before.gains.items():
        table.add_row(name, _gain(gain), _gain(tuning.after.gains[name]))
    return table


def _notes(tuning: Tuning) -> Iterator[str]:
    if exceeded := tuning.exceeded:
        yield f"The gains after exceed a limit in the held-out set: {', '.join(exceeded)}."
    yield (
        f"cost = mean of z_track + {tuning.weight:g} · u_total; gains with which a run trips or exceeds a limit rank "
        "behind all others. Error, saturation and changes are the largest of all runs. Training: "
        f"{_cases(tuning, held_out=False)}. Held out: {_cases(tuning, held_out=True)}."
    )
    yield (
        f"Delay and frames lost again and again: the most with which the error stays within {tuning.within_deg:g}° in "
        f"the second half of {tuning.margin_duration_s:g} s, without a watchdog, in the first training case."
    )
    if tuning.without_effect:
        yield f"Without effect here, and not changed: {', '.join(tuning.without_effect)}."
    before, after = tuning.before.certificate, tuning.after.certificate
    yield f"Before and after: {before}" if before == after else f"Before: {before}\nAfter: {after}"


def _cases(tuning: Tuning, *, held_out: bool) -> str:
    cases = tuning.held_out if held_out else tuning.training
    if not cases:
        return "none"
    seeds, winds = sorted({case.seed for case in cases}), sorted({case.wind for case in cases})
    return f"seeds {seeds[0]}…{seeds[-1]}, wind × {', '.join(f'{wind:g}' for wind in winds)}"


def _gain(gain: Gain) -> str:
    return f"{gain:g}" if isinstance(gain, float) else ", ".join(f"{value:g}" for value in gain)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
