"""Costs of a search for gains: runs with the same gains in sum, their limits, and the rank of a candidate.

A candidate's cost is the mean of z_track + weight · u_total over its runs. Candidates are ranked by cost/(1 s + cost),
which is below 1. One that trips or exceeds a limit in any case ranks behind all others, at 1 + 1 for each run that
trips + the part of the time that it did not last + the excess over each limit as a part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.lab.tune_runs import Ran

MORE: Final = 1.25
"""A limit that is not given is so many times what the configured gains have."""


class Limits(BaseModel):
    """What a candidate must keep to in every training case; null is no limit."""

    model_config = ConfigDict(frozen=True)

    saturated: float | None = Field(description="largest part of the ticks with a voltage at its limit [1]")
    changes_per_s: float | None = Field(description="most changes of a commanded voltage [1/s]")


class Summary(BaseModel):
    """Runs with the same gains under several cases. Figures are null where all trip; costs where any does."""

    model_config = ConfigDict(frozen=True)

    cost: float | None = Field(description="mean of z_track + weight · u_total; null where a run trips [s]")
    z_track: float | None = Field(description="mean [s]")
    u_total: float | None = Field(description="mean [V²·s]")
    settled_deg: float | None = Field(description="largest attitude error in the second half, of all runs [deg]")
    saturated: float | None = Field(description="largest part of the ticks with a voltage at its limit [1]")
    changes_per_s: float | None = Field(description="most changes of a commanded voltage [1/s]")
    trips: int = Field(description="runs that ended early")
    reason: str | None = Field(description="why the first of them did")


def limits_of(before: Summary, given: Limits) -> Limits:
    """The limits given; others are MORE times what the configured gains have, if none of their runs trips."""
    configured = {"saturated": before.saturated, "changes_per_s": before.changes_per_s}
    own = {name: None if value is None or before.trips else MORE * value for name, value in configured.items()}
    return Limits(**own | given.model_dump(exclude_none=True))


def rank(rans: Sequence[Ran], limits: Limits, weight: float) -> float:
    """What is minimised: as the module says, below 1 unless a run trips or exceeds a limit [1]."""
    exceeded = sum(2 - ran.lasted for ran in rans if ran.reason)
    for limit, values in (
        (limits.saturated, [ran.saturated for ran in rans]),
        (limits.changes_per_s, [ran.changes_per_s for ran in rans]),
    ):
        if limit is not None:
            exceeded += max(0.0, max(values) - limit) / max(limit, 1e-3)
    if exceeded:
        return 1 + exceeded
    cost = float(np.mean([ran.z_track + weight * ran.u_total for ran in rans]))
    return cost / (1 + cost)


def summary(rans: Sequence[Ran], weight: float) -> Summary:
    """Runs with the same gains in sum; the weight is of u_total [1/V²]."""
    reasons = [ran.reason for ran in rans if ran.reason]
    whole = [ran for ran in rans if not ran.reason]
    z_track, u_total = (
        float(np.mean([getattr(ran, name) for ran in whole])) if whole else None for name in ("z_track", "u_total")
    )
    settled, saturated, changes = (
        max((getattr(ran, name) for ran in whole), default=None)
        for name in ("settled_deg", "saturated", "changes_per_s")
    )
    complete = z_track is not None and u_total is not None and not reasons
    return Summary(
        cost=z_track + weight * u_total if complete else None,  # type: ignore[operator]  # they are numbers
        z_track=z_track,
        u_total=u_total,
        settled_deg=settled,
        saturated=saturated,
        changes_per_s=changes,
        trips=len(reasons),
        reason=reasons[0] if reasons else None,
    )


def worse(before: Summary, after: Summary) -> str | None:
    """In what one set of runs is worse than another."""
    if after.trips > before.trips:
        return f"{after.trips} runs trip, before {before.trips}: {after.reason}"
    if before.cost is not None and after.cost is not None and after.cost > before.cost:
        return f"the cost rises from {before.cost:.4g} to {after.cost:.4g}"
    return None
