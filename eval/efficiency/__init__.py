"""Latency, power, energy and memory of the paper's rows (imported lazily)."""
