"""The tubes room."""
