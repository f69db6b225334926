"""The constants room."""
