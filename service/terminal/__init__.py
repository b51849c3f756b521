"""Terminal output: tables, progress bars, live view, log lines."""
