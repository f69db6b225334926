"""Proofs as data: one writer for each engine, and the file that holds them."""

from __future__ import annotations

from certbound.safety.certificates.file import certificate_data, certificate_text, problem_data, restated

__all__ = ["certificate_data", "certificate_text", "problem_data", "restated"]
