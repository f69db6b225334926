"""The checker room."""
