"""Verify every problem of the gallery, draw it, and write the page: ``python docs/gallery/build.py [name ...]``.

Pictures go to docs/pictures, the page is docs/gallery.md. What is printed is what certbound answered on this run.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import certbound as cb
from certbound.cli.pictures import drawn_reach, scene_of, values_of, write_picture
from certbound.display import at_least_text, log10_text, name_text
from certbound.plotting import Scene, draw_scene, draw_values

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent / "pictures"
RESULTS = HERE / "results.json"
LIMIT = 120.0
PATHS = 60
ORDER = (
    "warehouse_robot", "crossing", "planar_drone", "cart_pole", "rendezvous", "twelve_rooms",
    "reactor", "epidemic", "double_well", "van_der_pol", "logistic_map", "swing_in_wind",
)  # fmt: skip


def main(names: list[str]) -> None:
    """Do the work for some problems, or for all of them, and write the page of what is known."""
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in names or ORDER:
        results[name] = answer(name)
        sys.stdout.write(f"{name}: {results[name]['status']} {results[name]['bound']}\n")
    RESULTS.write_text(json.dumps({name: results[name] for name in ORDER if name in results}, indent=1) + "\n")
    (HERE.parent / "gallery.md").write_text(page(results), encoding="utf-8")


def answer(name: str) -> dict[str, Any]:
    """The verdict on one problem, with its picture drawn."""
    problem = cb.load(HERE / f"{name}.toml")
    begun = time.process_time()
    verdict = cb.verify_safety(problem, time_limit=LIMIT)
    seconds = time.process_time() - begun
    bound = f"{log10_text(verdict.log10_delta)}{at_least_text(verdict.log10_lower)}"
    title = f"{name_text(problem.name)}: {verdict.status}, P({problem.failing}) <= {bound}"
    draw(problem, verdict, PICTURES / f"{name}.png", title)
    smaller(PICTURES / f"{name}.png")
    lines = (HERE / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    return {
        "status": verdict.status, "bound": bound, "asked": problem.delta, "states": problem.system.dimension,
        "method": verdict.method, "seconds": seconds, "words": lines[0].removeprefix("# "), "name": problem.name,
    }  # fmt: skip


def draw(problem: cb.Problem, verdict: cb.Verdict, path: Path, title: str) -> None:
    """The picture that ``certbound verify --plot`` draws, small enough to keep."""
    if verdict.reach is None:
        starts = values_of(problem, verdict)
        reach = drawn_reach(problem, verdict) if starts is None else None
        if starts is None and reach is None:
            raise ValueError(f"`{path.stem}` has nothing that could be drawn; {verdict.reason}")
        figure = draw_values(starts, title) if reach is None else draw_scene(scene_of(problem, verdict, reach, title))
        write_picture(path, figure, dpi=90)
        return
    paths = cb.sample_paths(problem, paths=PATHS, rng=np.random.default_rng(0))
    times = np.linspace(0.0, float(problem.horizon), paths.shape[1])
    write_picture(path, draw_scene(replace(Scene.of(verdict), times=times, paths=paths, title=title)), dpi=90)


def smaller(path: Path) -> None:
    """The same picture in 64 colours."""
    from PIL import Image

    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(64)
    few.save(path, optimize=True)


def page(results: dict[str, dict[str, Any]]) -> str:
    """The gallery as Markdown."""
    lines = [
        "# Gallery", "",
        "Problems of several fields, each a file to start from: `certbound verify docs/gallery/NAME.toml`. The answers",
        "and the seconds of processor time are those of the last run of `python docs/gallery/build.py`, which draws",
        "the pictures and writes this page.", "",
        "| problem | states | answer | P(leaving) at most | asked | engine | seconds |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, row in results.items():
        lines.append(
            f"| [{row['name']}](#{name.replace('_', '-')}) | {row['states']} | {row['status']} | {row['bound']} "
            f"| {row['asked']:g} | {row['method']} | {row['seconds']:.1f} |"
        )
    for name, row in results.items():
        title = name.replace("_", " ")
        lines += [
            "", f"## {title.capitalize()}", "",
            f"{row['words']} [`{name}.toml`](gallery/{name}.toml)", "",
            f"![{row['name']}: {row['status']}, tubes, limits and sample paths](pictures/{name}.png)",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(sys.argv[1:])
