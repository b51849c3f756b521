"""Operator commands, host checks, systemd units and the payload rate."""
