"""The theory and the bench, in lockstep: experiments, the paper's tables, calibration, and what bits cost."""
