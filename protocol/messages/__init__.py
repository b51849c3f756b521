"""Topics, JSON messages, state machines and the trace, without I/O."""
