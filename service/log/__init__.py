"""The log: what records it, what reads it, and what it answers."""
