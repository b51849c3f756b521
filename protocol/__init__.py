"""Contract of the loop's two ends: wire format, messages, transports and time; SPEC.md is the normative text."""
