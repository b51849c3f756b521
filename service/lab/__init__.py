"""Experiments in lockstep: one loop, the paper's tables, calibration, error against bits, the demo."""
