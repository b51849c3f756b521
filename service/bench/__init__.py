"""Benchmarks: what aeroloop takes, beside the floor of the same machine in the same minutes."""
