"""Problem files: read, checked, written."""

from __future__ import annotations

from certbound.problem.files.loading import load, notes, save
from certbound.problem.files.schema import json_schema
from certbound.problem.files.writing import content_of

__all__ = ["content_of", "json_schema", "load", "notes", "save"]
