"""Firmware: the wire and the plant's node in C99, and the configuration they are compiled with."""
