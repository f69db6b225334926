"""How a report looks on a screen, on a telephone and on paper."""

from __future__ import annotations

from typing import Any

from certbound.plotting.scene import BLUE

LAYOUT: dict[str, Any] = {
    "margin": {"l": 55, "r": 15, "t": 30, "b": 45},
    "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "font": {"size": 13},
    "hovermode": "closest",
}
SMALL: dict[str, Any] = {"margin": {"l": 45, "r": 10, "t": 8, "b": 38}, "font": {"size": 11}}
SCRIPT = """
const plots = document.querySelectorAll(".plot");
const follow = new ResizeObserver(entries => entries.forEach(entry => Plotly.Plots.resize(entry.target)));
plots.forEach(plot => follow.observe(plot));
window.addEventListener("beforeprint", () => plots.forEach(plot => Plotly.Plots.resize(plot)));
"""
STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ font: 16px/1.5 system-ui, sans-serif; margin: 0; color: #1a1a1a; background: #f4f5f7; }}
main {{ max-width: 1280px; margin: 0 auto; padding: 0 1rem 3rem; display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); align-items: start; }}
h1, #verdict, #problem, .whole {{ grid-column: 1 / -1; margin-bottom: 0; }}
section {{ background: white; border-radius: 8px; padding: 0.5rem 1rem 1rem; min-width: 0;
  border-top: 4px solid #c7ccd3; }}
section.SAFE {{ border-top-color: #009E73; }} section.UNKNOWN {{ border-top-color: #E69F00; }}
section.UNSAFE, section.UNSAFE_NOMINAL {{ border-top-color: #D55E00; }}
h2 {{ font-size: 1.1rem; }} h3 {{ font-size: 0.95rem; margin: 0.25rem 0; overflow-wrap: anywhere; }}
.status {{ font-size: 1.8rem; font-weight: 700; margin: 0; }}
.halves, .multiples {{ display: grid; gap: 0.75rem 1.5rem; }}
.halves {{ grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); }}
.halves > div, .multiples > div {{ min-width: 0; }}
.multiples {{ grid-template-columns: repeat(auto-fill, minmax(min(100%, 280px), 1fr)); }}
figure {{ margin: 0; }} .plot {{ width: 100%; height: 360px; overflow: hidden; }}
.plot.tall {{ height: 460px; }} .plot.small {{ height: 210px; }}
figcaption {{ color: #444; font-size: 0.85rem; }}
.legend {{ margin: 0; }} .legend span {{ margin-right: 1.25rem; white-space: nowrap; font-size: 0.9rem; }}
.legend i {{ display: inline-block; width: 1.6em; margin-right: 0.4em; vertical-align: middle; background: var(--c); }}
.legend .line {{ height: 2px; }} .legend .area {{ height: 0.8em; }}
.legend .dashes {{ height: 0; background: none; border-top: 2px dashed var(--c); }}
.wide {{ overflow-x: auto; }} table {{ border-collapse: collapse; }} code {{ word-break: break-all; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.25rem 0.75rem 0.25rem 0;
  border-bottom: 1px solid #e3e5e8; }}
math {{ font-size: 1.05em; }} mtd {{ padding: 0.25em 0.15em; }}
.left {{ text-align: right; }} .right {{ text-align: left; }}
math[display="block"] {{ display: inline-block; }}
pre {{ overflow-x: auto; background: #f4f5f7; padding: 0.5rem; }}
.skip {{ position: absolute; left: -9999px; }} .skip:focus {{ left: 1rem; top: 0.5rem; }}
:focus-visible {{ outline: 3px solid {BLUE}; }}
@media (max-width: 480px) {{
  main {{ padding: 0 0.5rem 2rem; }} section {{ padding: 0.5rem 0.6rem 0.75rem; }}
  #verdict tr, #problem tr, #engines tr {{ display: block; border-bottom: 1px solid #e3e5e8; }}
  #verdict tr > *, #problem tr > *, #engines tr > * {{ display: block; border: 0; padding: 0.1rem 0; }}
  #engines thead, #engines td:nth-child(2), #engines td:empty {{ display: none; }}
  #engines td:nth-child(3)::before {{ content: "P at most: "; }}
  #engines td:nth-child(4)::before {{ content: "margin: "; }} #engines td:nth-child(5)::before {{ content: "time: "; }}
}}
@media print {{
  body {{ background: white; font-size: 11px; }} main {{ display: block; padding: 0; }}
  section {{ break-inside: avoid; border-radius: 0; }} section.whole {{ break-inside: auto; }}
  .multiples > div, tr {{ break-inside: avoid; }} .modebar, .skip, .slider-container {{ display: none; }}
  .multiples {{ grid-template-columns: repeat(2, 1fr); }} .wide {{ overflow: visible; }}
}}
"""
