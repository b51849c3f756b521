"""HTML page of one or several runs that needs no other file: `--html` of `aeroloop log review` and `compare`."""
