"""Bench: what this project takes beside what the machine gives, item by item, in one run."""
