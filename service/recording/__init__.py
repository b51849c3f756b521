"""The recorder process and the MCAP files that it writes."""
