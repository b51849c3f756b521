"""Bounds of Lemma 1, Theorem 1 and Corollary 1, and certificates of a configuration."""
