"""The values room: exit probabilities on grids, from above and from below, for few states at any noise.

The probability of failure is the fixed point of a backward recursion (discrete time) or of a parabolic equation
(continuous time). Numerics propose an approximate solution; enclosures prove that it lies above (below) the true one.
"""
