"""Hardware-in-the-loop tests: the `hil` fixture, the process group, the conformance suite of a plant end."""
