"""What the paper proves, evaluated: the bounds of Lemma 1 and Theorem 1, certificates, and what would satisfy them."""
