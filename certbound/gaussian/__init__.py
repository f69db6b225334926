"""Probabilities of Gaussian events, bounded from above; this room knows no tube and no engine."""
