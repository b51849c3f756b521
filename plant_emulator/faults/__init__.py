"""Faults to inject: their notation, and what they do to sensors, motors and frames."""
