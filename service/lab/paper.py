"""Published results of the paper, Tables C.2–C.4.

Rows are bits of the input, columns bits of the output; None is the paper's "cont.".
"""

from __future__ import annotations

from typing import Final

INPUT_BITS: Final[tuple[int | None, ...]] = (6, 7, 8, 9, 10, None)
OUTPUT_BITS: Final[tuple[int | None, ...]] = (8, 9, 10, None)

Z_TRACK: Final = (
    (49, 51, 38, 38),
    (43, 40, 37, 40),
    (45, 40, 39, 45),
    (45, 40, 40, 43),
    (47, 40, 39, 38),
    (43, 35, 34, 35),
)
"""Table C.2 [1e-4 s]."""

U_TOTAL: Final = (
    (8042, 8168, 7884, 7945),
    (7881, 7935, 7897, 8023),
    (8095, 7895, 7898, 8017),
    (8055, 7857, 7959, 8034),
    (8121, 7970, 7892, 7899),
    (8147, 7854, 7767, 7980),
)
"""Table C.3 [V²·s]."""

WIND: Final = {
    "continuous": {"calm": {"z_track_1e-4": 35, "u_total": 7980}, "wind": {"z_track_1e-4": 97, "u_total": 9241}},
    "quantized_8_6": {"calm": {"z_track_1e-4": 49, "u_total": 8042}, "wind": {"z_track_1e-4": 119, "u_total": 9699}},
}
"""Table C.4."""

DURATION_S: Final = 50.0
"""Length of every experiment [s]."""
