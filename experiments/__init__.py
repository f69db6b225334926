"""What the figures, tables and benchmarks are made of: every module here computes, none draws.

``python -m experiments.fig2 [--full] [--out FOLDER]`` writes ``fig2.npz`` and ``fig2.json``.
"""
