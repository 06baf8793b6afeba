"""Sequences, metrics, runs and pictures around the core (imported lazily, module by module)."""
