"""Errors for people: one line that states what is wrong and what to do."""

from __future__ import annotations


class AeroloopError(Exception):
    """Base of every error that is meant for a person. Its text is one line."""
