"""Table of a sweep: a Parquet file with a row an experiment, in the order of the axes' values.

The columns are the varied keys, the seed, the figures, the reason where there are none, and what names the row. Each
has its description, with the unit, in its field's metadata; the file's metadata have the configuration.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
import pyarrow.parquet

from aeroloop.protocol import wording
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.lab.sentinel import fingerprint
from aeroloop.service.logs.outputs import OutputError, check_output, writing
from aeroloop.service.sweep.rows import Key, Measured

if TYPE_CHECKING:
    from aeroloop.service.sweep.sweep import Plan

WITHIN_DEG: Final = b"aeroloop.within_deg"
"""Key of a table's metadata: bound of the attitude error for its margins [deg]."""

_TEXTS: Final = {
    "seed": "of wind and sensors",
    "measurement_frames_per_s": "frames sent by the plant end [1/s]",
    "measurement_bits_per_s": "their payload bits, padding included [1/s]",
    "command_frames_per_s": "frames sent by the controller [1/s]",
    "command_bits_per_s": "their payload bits, padding included [1/s]",
    "reason": "why there are no figures: why the plant tripped",
    "configuration": "SHA-256 of what the experiment depends on, but for the seed",
    "version": "of aeroloop, and a digest of what it computes",
}


def check_table(
    out: Path,
    planned: Plan,
    inputs: Sequence[Path | None] = (),
    *,
    within_deg: float | None = None,
    force: bool = False,
) -> None:
    """Raise OutputError if the table cannot be written there, as `check_output` does.

    Without `force` a sweep replaces a table only if it has each of its rows and varied keys. `within_deg` is the bound
    of the margins that a comparison of laws adds to its table [deg].
    """
    if out.suffix != ".parquet":
        raise OutputError(f"--out must name a .parquet file, not {out}")
    check_output(out, inputs, force=True)
    if out.exists() and not force and not _continues(planned, out, within_deg):
        raise OutputError(
            f"{out} exists already and is no table of this sweep; name another file, or replace it with --force"
        )


def _continues(planned: Plan, out: Path, within_deg: float | None) -> bool:
    """Whether a sweep has each row and each varied key of the table in a file."""
    try:
        schema = pyarrow.parquet.read_schema(out)
        varied = schema.names[: schema.names.index("seed")]
        names = pyarrow.parquet.read_table(out, columns=["configuration", "seed", "version"])
    except (OSError, ValueError):  # no table, or none of a sweep
        return False
    configurations, seeds, versions = (set(column.unique().to_pylist()) for column in names.columns)
    bound = json.loads((schema.metadata or {}).get(WITHIN_DEG, b"null"))
    return (
        set(varied) <= {axis.key for axis in planned.axes}
        and configurations <= {each.digest for each in planned.found}
        and seeds <= set(range(planned.seeds))
        and versions <= {fingerprint()}
        and bound in (None, within_deg)
    )


def write_table(out: Path, planned: Plan, keys: Sequence[Key], rows: Sequence[Measured]) -> None:
    """Write the table, in place of an older one. Raises OutputError."""
    varied = zip(*(each.values for each in planned.found for _ in range(planned.seeds)), strict=True)
    known = wording.keys(Settings)
    columns: dict[str, tuple[Any, str]] = {
        axis.key: (_varied(values), (axis.key in known and known[axis.key].description) or "")
        for axis, values in zip(planned.axes, varied, strict=True)
    }
    columns["seed"] = pa.array([key.seed for key in keys], pa.int64()), ""
    for i, name in enumerate(Measured._fields):
        kind = {"reason": pa.string(), "skipped_ticks": pa.int64()}.get(name, pa.float64())
        field = Figures.model_fields.get(name)
        columns[name] = pa.array([row[i] for row in rows], kind), (field and field.description) or ""
    columns["configuration"] = pa.array([key.configuration for key in keys]), ""
    columns["version"] = pa.array([key.version for key in keys]), ""
    fields = [
        pa.field(name, values.type, metadata={"description": _TEXTS.get(name, text)})
        for name, (values, text) in columns.items()
    ]
    facts = {"config": planned.settings.description(), "duration_s": planned.duration_s}
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    table = pa.Table.from_arrays([values for values, _ in columns.values()], schema=schema)
    with writing(out, force=True) as part:
        pyarrow.parquet.write_table(table, part, compression="zstd")


def _varied(values: Sequence[Any]) -> Any:
    """A column of values; of texts where they are of several kinds."""
    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return pa.array([None if value is None else str(value) for value in values])
