"""Review of a recorded session: figures of merit, timing, events, and a check against Theorem 1."""
