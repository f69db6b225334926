"""Random paths: how often they leave, how far they stray, with confidence limits."""
