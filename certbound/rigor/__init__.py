"""The rigor room."""
