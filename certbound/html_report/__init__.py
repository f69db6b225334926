"""One HTML page about a verdict: words, the problem in full, interactive pictures, numbers, how to get them again."""

from __future__ import annotations

from certbound.html_report.page import report_page

__all__ = ["report_page"]
