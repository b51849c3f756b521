"""The verbs of the command `aeroloop`, a module a group. Each parses, calls one function and prints."""
