"""Verdicts: the engines that prove them, and the certificates that carry the proof."""
