"""Faster implementations of the algorithm's steps, with the signatures of the torch reference (see ``select``)."""
