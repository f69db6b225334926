"""Three states."""
