"""Continuous time with noise in one of two coordinates: steps along the flow (Theorem K8-SL)."""
