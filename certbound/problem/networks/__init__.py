"""Neural networks as parts of models: read from layers, from JSON, NumPy and ONNX files, and called."""

from __future__ import annotations

from certbound.problem.networks.network_functions import NetworkFunction, network, write_network

__all__ = ["network", "NetworkFunction", "write_network"]
