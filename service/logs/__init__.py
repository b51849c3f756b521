"""Reading of logs: MCAP files, joined traces, recomputed ticks, replay, recovery and export."""
