"""Quanser."""
