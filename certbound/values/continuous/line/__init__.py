"""One state in continuous time: pieces of time with their own safe interval, and the chain of surfaces over them.

From the bottom: ``phases`` (what the constraints leave, piece by piece), ``moved_model`` (coordinates in which moving
limits stand still), ``profiles`` (what the proposal of a phase starts from), ``joins`` (one surface against the next),
``linked`` (the proof over all of them), ``ladder`` (finer and finer, until the work is spent), ``maps`` (every state
instead of the initial set), ``arrivals`` (targets), and by themselves ``stationary`` (means and rates) and ``passages``
(horizons without an end) and, of any number of states, ``sure_exits`` (noise that leads every path out in the end).
"""

from certbound.values.continuous.line.arrivals import bound_arrival, bound_ended
from certbound.values.continuous.line.ladder import bound_line
from certbound.values.continuous.line.maps import chart_line, chart_slabs
from certbound.values.continuous.line.passages import Lasting, bound_lasting
from certbound.values.continuous.line.phases import Limit, Phase, check_room, phase_of, value_at
from certbound.values.continuous.line.stationary import Rate, bound_mean_time, bound_rate
from certbound.values.continuous.line.sure_exits import SureExit, leaves_surely

__all__ = [
    "Lasting", "Limit", "Phase", "Rate", "SureExit", "bound_arrival", "bound_ended", "bound_lasting", "bound_line",
    "bound_mean_time", "bound_rate", "chart_line", "chart_slabs", "check_room", "leaves_surely", "phase_of", "value_at",
]
