"""Plant endpoint, sans-I/O: claims, sessions, watchdog, limits and the trace's rows."""
