"""Rendering of a review: an HTML page, PNG figures, and rows of figures of merit."""
