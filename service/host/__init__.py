"""Operator commands, host checks, systemd units, and keys of several hosts."""
