"""The console: one page of a running loop in a browser, and an operator's verbs on it."""
