"""Everything that can stand at the plant end of the loop."""
