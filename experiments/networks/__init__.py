"""Learned controllers: how the policies are trained, and what is proved with them."""
