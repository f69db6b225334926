"""Problem files to start from, one for each feature; NAME and FILE stand for the problem's name and its file."""

from __future__ import annotations

STARTERS = {
    "pendulum": """\
# A certbound problem: a noisy system, where it starts, where it must stay, for how long, and how surely.
# Check it with:  certbound verify FILE
name = "NAME"
time = "continuous"        # or "discrete": [dynamics] then gives the next state, and [noise] has a law
horizon = 4.0              # seconds (steps in discrete time)
delta = 1e-3               # allowed probability of leaving the safe set at any time up to the horizon
states = ["angle", "speed"]

[parameters]               # numbers used below; change them with  --set damping=0.8
gravity = 9.81
length = 1.0
damping = 0.5
sigma = 0.05

[disturbances]             # bounded, unknown, may depend on the past: name = [low, high]
push = [-0.02, 0.02]

[dynamics]                 # d(state)/dt: t + - * / **, sin cos tan tanh exp log sqrt abs min max ..., pi
angle = "speed"
speed = "-gravity/length*sin(angle) - damping*speed + push"

[noise]                    # g of  dx = f dt + g dW, one row a state
diffusion = [[0], ["sigma"]]

[initial]                  # exactly one of point, box, ball, gaussian
box = [[0.25, 0.35], [-0.05, 0.05]]

[[stay]]                   # the state stays inside each [[stay]] ...
box = { angle = [-1.0, 1.0] }

[[stay]]
halfspace = { normal = { speed = 1 }, bound = 4 }   # speed <= 4

[[avoid]]                  # ... and outside each [[avoid]]
ball = { center = { angle = 0.9, speed = 2.5 }, radius = 0.3 }
during = [0, 2]            # seconds; leave it out for the whole horizon
""",
    "union": """\
# Several starts: every [[initial]] counts, and the verdict is that of the worst one.
name = "NAME"
time = "discrete"
horizon = 10
delta = 1e-3
states = ["x1", "x2"]

[dynamics]                 # the next state
x1 = "x1 + 0.1*x2"
x2 = "x2 + 0.1*(x1**3/3 - x1 - x2)"

[noise]
law = "gaussian"
std = 0.01

[[initial]]
ball = { center = [1.5, 0], radius = 0.2 }

[[initial]]
box = [[-1.4, -1.2], [-0.5, 0.1]]

[[avoid]]
ball = { center = [-1, -1], radius = 0.4 }
""",
    "target": """\
# A target: a path fails if it breaks a constraint before it is there, or is not there in time.
name = "NAME"
time = "discrete"
horizon = 12
delta = 0.01
states = ["x"]

[dynamics]
x = "0.7*x"

[noise]
law = "gaussian"
std = 0.1

[initial]
point = [0.8]

[[stay]]
box = { x = [-1, 1] }

[[reach]]
box = { x = [-0.2, 0.2] }
# during = [4, 12]         # when the target counts; the whole horizon without it
""",
    "polygon": """\
# Obstacles from corners, and as intersections.
name = "NAME"
time = "continuous"
horizon = 3.0
delta = 1e-3
states = ["px", "py"]

[dynamics]
px = "1"
py = "-py"

[noise]
diffusion = [[0.03, 0], [0, 0.03]]

[initial]
point = [0, 0]

[[avoid]]
polygon = { vertices = [[1, 0.4], [2, 0.4], [1.5, 1]] }

[[avoid]]                  # the part of a box below a line
all = [ { box = { px = [0.5, 2], py = [-2, -0.3] } }, { halfspace = { normal = { px = -1, py = 1 }, bound = -1 } } ]
""",
    "packets": """\
# Noise by a table of values: a correction that gets lost one time in ten, which leaves the mean to [dynamics].
name = "NAME"
time = "discrete"
horizon = 20
delta = 0.05
states = ["x"]

[dynamics]
x = "0.7*x"

[noise]
law = "discrete"           # or histogram (edges, probabilities), triangular, uniform, gaussian, ...
values = [-0.9, 0.1]
probabilities = [0.1, 0.9]
scale = 0.2

[initial]
point = [0]

[[stay]]
box = { x = [-1.2, 1.2] }
""",
    "forever": """\
# An infinite horizon: the target is met at some time, with the limit kept until then.
name = "NAME"
time = "discrete"
horizon = inf
delta = 0.05
states = ["x"]

[dynamics]
x = "x - 0.3"

[noise]
law = "gaussian"
std = 0.3

[initial]
point = [0]

[[stay]]
halfspace = { normal = { x = 1 }, bound = 1 }

[[reach]]
halfspace = { normal = { x = 1 }, bound = -1 }
""",
    "growth": """\
# Noise that multiplies the state, and a domain that a path may leave: it ends there, and does not fail.
name = "NAME"
time = "discrete"
horizon = 6
delta = 0.2
states = ["x"]

[dynamics]
x = "where(x > 1, 0.9*x, 1.05*x)"

[noise]
law = "gaussian"
std = 1
matrix = [["0.1*x"]]       # of [dynamics] + matrix * noise: expressions in t and the states

[initial]
point = [1]

[[avoid]]
box = { x = [1.6, 1.8] }

[domain]
box = { x = [0.2, 3] }
leaving = "ends"           # or "unsafe"
""",
    "drawn": """\
# Constants that are drawn once and then stay, and constants of which only bounds are known.
name = "NAME"
time = "discrete"
horizon = 12
delta = 0.01
states = ["level"]

[random]                   # one law a constant: gaussian, uniform, triangular, laplace, discrete, histogram
leak = { law = "uniform", halfwidth = 0.1, mean = 0.3 }
load = { law = "discrete", values = [0, 0.2], probabilities = [0.9, 0.1] }

[uncertain]                # anywhere between, the same at all times
offset = [-0.01, 0.01]

[dynamics]
level = "(1 - leak)*level + 0.1*load + offset"

[noise]
law = "gaussian"
std = 0.1

[initial]
point = [0]

[[stay]]
box = { level = [-0.7, 0.7] }
""",
    "switching": """\
# A model that changes at known times: the clock decides, and every change is the end of a piece of time.
name = "NAME"
time = "continuous"
horizon = 6
delta = 1e-3
states = ["room", "wall"]
units = { time = "h", room = "K", wall = "K" }   # for humans: texts, axes and tables name them

[definitions]
heating = "where(t - 2*floor(t/2) < 1.25, 1, 0)"

[dynamics]
room = "-0.8*room + 0.5*wall + 0.6*heating - 0.3"
wall = "-wall + 0.3*tanh(room)"

[noise]
diffusion = [[0.08, 0], [0, 0.08]]

[initial]
box = [[-0.05, 0.05], [-0.05, 0.05]]

[[stay]]
box = { room = [-1.2, 1.2] }
""",
    "staying": """\
# A target that is not left again: from the first entry on the state stays in it, until the horizon.
name = "NAME"
time = "discrete"
horizon = 10
delta = 0.1
states = ["x"]

[dynamics]
x = "0.5*x"

[noise]
law = "triangular"
halfwidth = 0.2

[initial]
point = [0.9]

[[stay]]
box = { x = [-1, 1] }

[[reach]]
box = { x = [-0.3, 0.3] }
then = "stay"
""",
    "ruin": """\
# For ever, where failing is not certain: a reserve that grows on average, and must not be used up.
name = "NAME"
time = "continuous"
horizon = inf
delta = 0.05
states = ["reserve"]

[dynamics]
reserve = "1"

[noise]
diffusion = [[1]]

[initial]
point = [2]

[[stay]]
halfspace = { normal = { reserve = -1 }, bound = 0 }   # -reserve <= 0
""",
    "sampled": """\
# A controller that looks at sampling times only: its input is kept in between, while the plant moves on.
name = "NAME"
time = "continuous"
horizon = 2
delta = 1e-3
states = ["x"]

[inputs]                   # name = [low, high]
u = [-2, 2]

[dynamics]
x = "0.5*x + u"

[plan]
u = "-2*x"
hold = 0.25                # seconds; the horizon is a whole number of them

[noise]
diffusion = [[0.1]]

[initial]
gaussian = { mean = [0.1], std = 0.05 }

[[stay]]
box = { x = [-1, 1] }
""",
}
"""By the name that ``certbound new --example`` takes."""
