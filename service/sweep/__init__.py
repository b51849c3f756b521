"""Sweeps: a full factorial of configurations and seeds, run by any workers, in a file that survives a crash."""
