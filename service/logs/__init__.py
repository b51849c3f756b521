"""Logs: their files, the runs in them, replay, review and export."""
