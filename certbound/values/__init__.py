"""Value functions: the exit probability itself, computed on a grid and then proved."""
