"""The algorithm's steps for CPUs, compiled by numba, with the signatures of ``steps``."""
