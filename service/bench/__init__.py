"""Measurements of this machine and this program, each a ratio to a floor measured in the same run."""
