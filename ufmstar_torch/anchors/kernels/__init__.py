"""Kernels of the anchors for CPUs, compiled by numba."""
