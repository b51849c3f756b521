"""Tables of `lab burden`: one for each of the sensors, in the terminal or as Markdown.

A row is one experiment with its traffic under both policies, compared with float64 at every tick. A missing figure is a
dash, with the reason below. A terminal too narrow for all columns has a block for each policy, without how often values
change and the least time between frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from aeroloop.protocol.wire.frames import MIN_COUNTER_BITS
from aeroloop.service.lab.burden import Burden, Point

HEADER: Final = (
    "bits out/in",
    "quantizer",
    "z_track, 10⁻⁴ s",
    "u_total, V²·s",
    "changes/s",
    "every tick: kbit/s",
    "CAN kbit/s",
    "on change: frames/s",
    "ms between, mean",
    "least",
    "kbit/s",
    "CAN kbit/s",
)
_PIPE_WIDTH: Final = 160
_BLOCKS: Final = {"every tick": (0, 1, 2, 3, 5, 6), "on change": (0, 1, 7, 8, 10, 11)}
"""Columns of each block, where not all fit beside each other."""
_SPLIT: Final = "†"


def burden_table(burden: Burden) -> None:
    """Print the grid."""
    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_WIDTH  # folded lines cannot be unfolded in a file
    for name, text in burden.sensors.items():
        console.print(Text(f"sensors {name}: {text}", style="italic"))
        rows = list(_rows(burden, name))
        whole = range(len(HEADER))
        if _width(rows, whole) <= console.width:
            console.print(_table(rows, whole))
        else:
            for policy, columns in _BLOCKS.items():
                console.print(Text(f"\n{policy}", style="bold"))
                console.print(_table(rows, columns))
        for line in _reasons(burden, name):
            console.print(Text(line), soft_wrap=not console.is_terminal)
        console.print()
    for line in _notes(burden):
        console.print(Text(line), soft_wrap=not console.is_terminal)


def _least(rows: list[list[str]], i: int) -> int:
    """Least width of a column: a title folds between words, figures do not."""
    return max(len(text) for text in (*HEADER[i].split(), *(row[i] for row in rows)))


def _width(rows: list[list[str]], columns: Sequence[int]) -> int:
    return sum(_least(rows, i) + 1 for i in columns)


def _table(rows: list[list[str]], columns: Sequence[int]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i in columns:
        title = HEADER[i] if len(columns) == len(HEADER) else HEADER[i].rpartition(": ")[2]
        table.add_column(title, justify="left" if i < 2 else "right", width=_least(rows, i))
    for row in rows:
        table.add_row(*(Text(row[i]) for i in columns))
    return table


def markdown(burden: Burden) -> str:
    """Format the grid as Markdown."""
    lines: list[str] = []
    for name, text in burden.sensors.items():
        lines += [f"**Sensors `{name}`**: {text}", "", f"| {' | '.join(HEADER)} |"]
        lines += ["|" + "---|" * 2 + "--:|" * (len(HEADER) - 2)]
        lines += [f"| {' | '.join(row)} |" for row in _rows(burden, name)]
        lines += ["", *_reasons(burden, name), ""]
    return "\n".join([*lines, "\n\n".join(_notes(burden))])


def short_name(quantizer: str) -> str:
    """Name of a quantizer in a table or a legend."""
    return "hysteresis on ω" if quantizer == "hysteresis-rate" else quantizer.removesuffix("-uniform")


def _rows(burden: Burden, sensors: str) -> Iterator[list[str]]:
    points = burden.under(sensors)
    for always, changed in zip(points[::2], points[1::2], strict=True):
        label = short_name(always.quantizer) if always.quantizer else "float64"
        ratios = always.against_float64
        out, inp = changed.measurement, changed.command
        if ratios is None or always.z_track is None or always.u_total is None or out is None or inp is None:
            yield [always.bits, label, *["–"] * (len(HEADER) - 2)]
            continue
        yield [
            always.bits,
            label,
            f"{always.z_track * 1e4:.1f} (×{ratios.z_track:.{2 if ratios.z_track < 9.995 else 1}f})",
            f"{always.u_total:.0f}",
            f"{out.changes_per_s:.0f} + {inp.changes_per_s:.0f}",
            _payload(always),
            _bus(always),
            f"{out.frames_per_s:.0f} + {inp.frames_per_s:.0f}",
            f"{_ms(out.mean_interval_ms)} + {_ms(inp.mean_interval_ms)}",
            f"{_ms(out.least_interval_ms, 'g')} + {_ms(inp.least_interval_ms, 'g')}",
            _payload(changed),
            _bus(changed),
        ]


def _payload(point: Point) -> str:
    if point.bits_per_s is None or point.against_float64 is None:
        return "–"
    star = "★ " if point.pareto else ""
    return f"{star}{point.bits_per_s / 1e3:.1f} ({_share(point.against_float64.bits_per_s)})"


def _bus(point: Point) -> str:
    """Bits a second on the bus, and its load; marks a split frame and a load above 1."""
    if point.can_bits_per_s is None or point.can_load is None or point.measurement is None or point.command is None:
        return "–"
    split = _SPLIT if max(point.measurement.can_frames, point.command.can_frames) > 1 else ""
    load = _share(point.can_load) + (", too much" if point.can_load > 1 else "")
    return f"{point.can_bits_per_s / 1e3:.0f} ({load}){split}"


def _share(ratio: float) -> str:
    return f"{100 * ratio:.{0 if ratio > 0.0995 else 1}f}%"


def _ms(interval: float | None, digits: str = ".1f") -> str:
    return "–" if interval is None else f"{interval:{digits}}"


def _reasons(burden: Burden, sensors: str) -> Iterator[str]:
    """The reason of each empty row."""
    for point in burden.under(sensors):
        if point.reason is not None and point.transmit == "periodic":
            yield f"{_name(point)}: {point.reason}."


def _name(point: Point) -> str:
    return f"{point.bits} {short_name(point.quantizer)}" if point.quantizer else "float64"


def _notes(burden: Burden) -> Iterator[str]:
    rate, bits = burden.rate_hz, burden.counter_bits
    yield (
        f"{burden.duration_s:g} s each; of two numbers the first is measurements, the second "
        "commands; × and % are of float64 at every tick; ★ is on the Pareto front of z_track against payload bits."
    )
    yield (
        f"Every tick: {rate:g} + {rate:g} frames/s, {1e3 / rate:g} ms apart. On change: at least every "
        f"{burden.heartbeat_s * 1e3:g} ms. CAN: a classic bus of 1 Mbit/s and its load, worst-case stuffing, without "
        "heartbeats."
    )
    shorter = f"; {MIN_COUNTER_BITS} bits would carry {2 * MIN_COUNTER_BITS * rate / 1e3:g}"
    yield (
        f"The counter has {bits} bits: at every tick {rate:g} + {rate:g} frames/s carry {2 * bits * rate / 1e3:g} "
        f"kbit/s of it{shorter if bits > MIN_COUNTER_BITS else ''}, padding apart."
    )
    if any(part and part.can_frames > 1 for point in burden.points for part in (point.measurement, point.command)):
        yield (
            f"{_SPLIT} A frame of more than 8 bytes, reckoned as the classic frames that its bytes fill; in fact it "
            "goes as one CAN FD frame."
        )
