"""Pictures of problems and verdicts: sets, nominal, tubes, sample paths.

Figures are made without pyplot, so that nothing global changes and no window opens. Colours are those of
Okabe and Ito; what matters is told apart by dash pattern and hatching as well, so that grey prints and
colour-blind readers lose nothing. Everything drawn here is a rendering of sets that were proved elsewhere.
"""

from __future__ import annotations

from certbound.plotting.animation import animate
from certbound.plotting.picture import draw_scene
from certbound.plotting.scene import Scene, measured_rooms, noisy_reach
from certbound.plotting.sweep_maps import draw_sweep
from certbound.plotting.tubes import draw_constants, draw_tubes
from certbound.plotting.value_maps import draw_values

__all__ = [
    "Scene", "animate", "draw_constants", "draw_scene", "draw_sweep", "draw_tubes", "draw_values", "measured_rooms",
    "noisy_reach",
]  # fmt: skip
