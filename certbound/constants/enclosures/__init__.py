"""Functions over boxes: interval enclosures, ranges, branch and bound, measures in a metric."""

from __future__ import annotations

from certbound.constants.enclosures.branching import Supremum, bound_supremum, random_points, split_boxes
from certbound.constants.enclosures.coordinates import Metric, Spread
from certbound.constants.enclosures.enclosure import enclose
from certbound.constants.enclosures.ranges import bound_ranges

__all__ = ["bound_ranges", "bound_supremum", "enclose", "Metric", "random_points", "split_boxes", "Spread", "Supremum"]
