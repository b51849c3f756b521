"""Rendering of a review: an HTML page, figures for a paper, and rows of figures of merit."""
