"""Operator commands, host checks, the soak test, systemd units and the payload rate."""
