"""Two problem files that are right, for the tests that put something wrong into them."""

from __future__ import annotations

__all__ = ["GOOD", "STEPS", "change"]

GOOD = """
name = "swing"
time = "continuous"
horizon = 1.0
delta = 1e-3
states = ["angle", "speed"]
[parameters]
sigma = 0.05
[dynamics]
angle = "speed"
speed = "-sin(angle) - speed"
[noise]
diffusion = [[0], ["sigma"]]
[initial]
box = [[-0.1, 0.1], [-0.1, 0.1]]
[[stay]]
box = { angle = [-1, 1] }
"""
STEPS = """
name = "steps"
time = "discrete"
horizon = 5
states = ["x"]
[dynamics]
x = "0.5*x"
[noise]
law = "gaussian"
std = 0.1
[initial]
point = [0]
[[stay]]
box = { x = [-1, 1] }
"""


def change(old: str, new: str, text: str = GOOD) -> str:
    """The text of a file with something else in it."""
    assert old in text
    return text.replace(old, new)
