"""Errors for people: one line that states what is wrong and what to do."""

from __future__ import annotations


class AeroloopError(Exception):
    """Base of every error that is meant for a person. Its text is one line."""

    exit_code = 1
    """Of the command that it ends."""


class ConfigError(AeroloopError):
    """The configuration is wrong; one line with the key and its allowed values."""

    exit_code = 2
