"""What the advice of the guide on speed is worth: ``python -m experiments.advice`` prints its table.

Seconds are of processor time of this process, after one run that loads and compiles; bounds do not depend on them.
"""

from __future__ import annotations

import time
from typing import Any

import certbound as cb
from certbound.display import log10_text

__all__ = ["CASES", "rows"]

CASES: dict[str, tuple[str, dict[str, float], dict[str, Any]]] = {
    "`unicycle`": ("unicycle", {}, {}),
    "`unicycle --method linear`": ("unicycle", {}, {"method": "linear"}),
    "`unicycle --method linear --horizon 1`": ("unicycle", {"horizon": 1.0}, {"method": "linear"}),
    "`chain_rest`": ("chain_rest", {}, {}),
    "`chain_rest --method linear`": ("chain_rest", {}, {"method": "linear"}),
    "`chain_rest --method linear --smallest`": ("chain_rest", {}, {"method": "linear", "smallest": True}),
    "`ou`": ("ou", {}, {}),
    "`ou --method kummer`": ("ou", {}, {"method": "kummer"}),
    "`ou --method values`": ("ou", {}, {"method": "values"}),
}


def rows() -> list[list[str]]:
    """What was asked, the answer and its bound, the seconds."""
    found = []
    for words, (name, changes, options) in CASES.items():
        problem = cb.load(name).replace(**changes)
        cb.verify_safety(problem, time_limit=60, **options)
        begun = time.process_time()
        verdict = cb.verify_safety(problem, time_limit=60, **options)
        seconds = time.process_time() - begun
        found.append([words, verdict.status, log10_text(verdict.log10_delta), f"{seconds:.2f}"])
    return found


if __name__ == "__main__":
    from experiments.performance import table

    print(table(["`certbound verify ...`", "answer", "proved: P <=", "seconds"], rows()))
