"""Recording: the recorder process and the files that it writes."""
