"""The checker: proves a certificate again from its file alone.

It shares no numerical code with what wrote the certificate: ball arithmetic (python-flint), its own differentiation,
and the description of a tape are all it uses. Nothing in a file is executed; time, memory and depth are bounded.

Examples
--------
>>> from certbound.checker import check_data
>>> check_data({"format": "something else"})
Traceback (most recent call last):
    ...
certbound.errors.CertificateError: `certificate` must have `version`.
"""

from certbound.checker.check import SECONDS, VERSION, check_data, check_file, find_difference
from certbound.checker.reading import parse, read
from certbound.checker.report import Report

__all__ = ["SECONDS", "VERSION", "Report", "check_data", "check_file", "find_difference", "parse", "read"]
