"""Command `aeroloop`: parses arguments, calls one function, prints its result."""
