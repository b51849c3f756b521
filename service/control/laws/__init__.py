"""Control laws: the paper's, baselines beside it, and the interface that a law of a user derives from as ours do."""
