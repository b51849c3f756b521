"""Conformance suite of the plant end, run with `pytest --pyargs`."""
