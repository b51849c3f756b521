"""Examples: configurations, and programs on the public API."""
