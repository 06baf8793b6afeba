"""How the kernels of the CPU are compiled (numba)."""

from __future__ import annotations

from typing import Any

from numba import njit

compiled: Any = njit(cache=True, nogil=True, error_model="numpy")

# For functions that allocate nothing and that only compiled code calls, which holds their arrays. numba counts the
# references of every view of an array otherwise (``table[i]`` as an argument, say), by an atomic operation that takes
# as long as some forty others; this option compiles the counting out, and refuses a function that allocates.
leaf: Any = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)

# A leaf in which multiply and add are joined where the processor can: one rounding less, not one more.
contracted: Any = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath={"contract"})
