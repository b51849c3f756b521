"""Bounds of Lemma 1, Theorem 1 and Corollary 1, certificates of a configuration, and remedies."""
