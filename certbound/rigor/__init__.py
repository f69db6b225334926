"""Arithmetic that proves: intervals with outward rounding, balls, matrices, norms."""
