"""Tubes around a noise-free trajectory from constants alone: the formulas, and which is smallest."""
