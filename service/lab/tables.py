"""Tables C.2–C.4 of the paper, predicted: one experiment per cell, in lockstep.

The plant was calibrated on two cells without quantization: calm (C.2, C.3) and windy (C.4). All others are predictions,
and only these count in the mean absolute relative error. Baselines without physics stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean, stdev
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings
from aeroloop.service.lab import paper
from aeroloop.service.lab.baselines import Baseline, baselines
from aeroloop.service.lab.cells import Cell, Pool, Result
from aeroloop.service.lab.workers import PROCESSES

CASES: Final = {"continuous": (None, None), "quantized_8_6": (8, 6)}
_FIGURES: Final = {"z_track_1e-4": "z_track", "u_total": "u_total"}
Rows = list[list[float]]
ERRORS: Final = (
    "Mean absolute relative error of cells that are not fitted (in brackets: of a fit to all cells), with the numbers "
    "fitted per figure and the cells that they are fitted to: calm; windy"
)
NOT_IDENTIFIED: Final = (
    "The tables do not identify dead zone, height of the centre of mass and Coulomb friction separately: with a dead "
    "zone of 2.5 V, and the other two fitted again, they are predicted as well."
)


class Table(BaseModel):
    """A predicted table and the published one."""

    model_config = ConfigDict(frozen=True)

    ours: Any
    paper: Any
    spread: Any = Field(default=None, description="standard deviation over seeds, shaped as `ours`; null for one seed")
    mare: float = Field(description="mean absolute relative error of the predicted cells [1]")
    baselines: list[Baseline]


class Tables(BaseModel):
    """The three tables, in the paper's units."""

    model_config = ConfigDict(frozen=True)

    C2: Table = Field(description="z_track [1e-4 s]; rows: bits of the input, columns: bits of the output")
    C3: Table = Field(description="u_total [V²·s]")
    C4: Table = Field(description="both, calm and windy; mare over the quantized windy cell's two figures")


def predict(
    settings: Settings, seeds: int = 1, progress: Callable[[int, int], None] | None = None, engine: str = PROCESSES
) -> Tables:
    """Run every cell, `seeds` times each with seeds from 0 up.

    Args:
        settings: The configuration; each cell sets bits and wind.
        seeds: Number of runs per cell; a figure is their mean.
        progress: Called with cells done and cells in all.
        engine: As of `Workers`.

    Raises:
        PlantError: The plant is no emulated body, so there is no wind on it.
    """
    settings.plant.mechanism()
    calm = [(out, inp, False) for inp in paper.INPUT_BITS for out in paper.OUTPUT_BITS]
    windy = [(*bits, True) for bits in CASES.values()]
    jobs = [(settings, Cell(*cell, seed)) for cell in (*calm, *windy) for seed in range(seeds)]
    with Pool(engine) as pool:
        results = pool.run(jobs, lambda done: progress(done, len(jobs)) if progress else None)
    runs = {cell: results[i * seeds : (i + 1) * seeds] for i, cell in enumerate((*calm, *windy))}
    grids = _grid(runs, "z_track", paper.Z_TRACK), _grid(runs, "u_total", paper.U_TOTAL)
    return Tables(C2=grids[0], C3=grids[1], C4=_wind(runs))


_Runs = dict[tuple[int | None, int | None, bool], list[Result]]


def _mean(results: Sequence[Result], name: str) -> float:
    return fmean(float(getattr(result, name)) for result in results)


def _spread(results: Sequence[Result], name: str) -> float:
    return stdev(float(getattr(result, name)) for result in results)


def _grid(runs: _Runs, name: str, published: Sequence[Sequence[int]]) -> Table:
    def rows(value: Callable[[Sequence[Result], str], float]) -> Rows:
        return [[round(value(runs[out, inp, False], name), 2) for out in paper.OUTPUT_BITS] for inp in paper.INPUT_BITS]

    ours = rows(_mean)
    errors = [
        abs(mine - theirs) / theirs
        for mine_row, their_row in zip(ours, published, strict=True)
        for mine, theirs in zip(mine_row, their_row, strict=True)
    ][:-1]  # the last cell, cont/cont, is the one the plant was calibrated on
    seeds = len(next(iter(runs.values())))
    return Table(
        ours=ours,
        paper=[list(row) for row in published],
        spread=rows(_spread) if seeds > 1 else None,
        mare=fmean(errors),
        baselines=baselines([published], fitted=(-1, -1)),
    )


def _wind(runs: _Runs) -> Table:
    def both(value: Callable[[Sequence[Result], str], float]) -> dict[str, dict[str, dict[str, float]]]:
        return {
            case: {
                air: {key: round(value(runs[*bits, windy], name), 2) for key, name in _FIGURES.items()}
                for air, windy in (("calm", False), ("wind", True))
            }
            for case, bits in CASES.items()
        }

    ours = both(_mean)
    predicted, published = ours["quantized_8_6"]["wind"], paper.WIND["quantized_8_6"]["wind"]
    seeds = len(next(iter(runs.values())))
    return Table(
        ours=ours,
        paper=paper.WIND,
        spread=both(_spread) if seeds > 1 else None,
        mare=fmean(abs(predicted[name] - published[name]) / published[name] for name in published),
        baselines=baselines(
            [[[air[name] for air in case.values()] for case in paper.WIND.values()] for name in _FIGURES],
            fitted=(0, 1),
            scored=(1, 1),
        ),
    )


def comparison(tables: Tables) -> list[list[str]]:
    """Our errors and the baselines' as rows of text, a header first."""
    each, digits = (tables.C2, tables.C3, tables.C4), (1, 2, 1)
    header = ["prediction", "numbers", "cells", "z_track", "u_total", "windy cell"]
    ours = ["ours", "1; 2", "1; 2", *(f"{table.mare:.{n}%}" for table, n in zip(each, digits, strict=True))]
    rows = [header, ours]
    for baseline in zip(*(table.baselines for table in each), strict=True):
        calm, _, windy = baseline
        counts = f"{calm.parameters}; {windy.parameters}", f"{calm.cells}; {windy.cells}"
        errors = (
            f"{b.mare_left_out:.{n}%}{'' if b.mare is None else f' ({b.mare:.{n}%})'}"
            for b, n in zip(baseline, digits, strict=True)
        )
        rows.append([calm.name, *counts, *errors])
    return rows


def _beside(ours: float, theirs: float, spread: float | None, digits: int) -> str:
    return f"{ours:.{digits}f}{'' if spread is None else f' ±{spread:.{digits}f}'} ({theirs})"


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text, a header first, as a Markdown table."""
    header, *rest = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([header, f"|---{'|--:' * (len(rows[0]) - 1)}|", *rest])


def markdown(tables: Tables) -> str:
    """Format the tables as Markdown: ours, with the paper's in brackets."""
    lines: list[str] = []
    for title, table, digits in (
        ("z_track, 10⁻⁴ s (Table C.2)", tables.C2, 1),
        ("u_total, V²·s (Table C.3)", tables.C3, 0),
    ):
        header = " | ".join("cont" if out is None else str(out) for out in paper.OUTPUT_BITS)
        lines += [f"**{title}**: ours (paper's)", "", f"| bits in ╲ out | {header} |", "|---" * 5 + "|"]
        for i, inp in enumerate(paper.INPUT_BITS):
            cells = [
                _beside(table.ours[i][j], table.paper[i][j], table.spread and table.spread[i][j], digits)
                for j in range(len(paper.OUTPUT_BITS))
            ]
            lines.append(f"| {'cont' if inp is None else inp} | {' | '.join(cells)} |")
        lines.append("")
    lines += ["**With and without wind (Table C.4)**: ours (paper's)", "", "| | z_track calm | u_total calm | z_track "
              "wind | u_total wind |", "|---|---|---|---|---|"]  # fmt: skip
    for case, label in (("continuous", "continuous"), ("quantized_8_6", "8 bits out, 6 in")):
        ours, theirs, spread = (part and part[case] for part in (tables.C4.ours, tables.C4.paper, tables.C4.spread))
        cells = [
            _beside(ours[air][name], theirs[air][name], spread and spread[air][name], digits)
            for air in ("calm", "wind")
            for name, digits in (("z_track_1e-4", 1), ("u_total", 0))
        ]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    lines += ["", f"**{ERRORS}**", "", markdown_table(comparison(tables)), "", NOT_IDENTIFIED]
    return "\n".join(lines)
