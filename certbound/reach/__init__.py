"""The reach room."""
