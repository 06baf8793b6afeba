"""How code for the CPU is compiled (numba): kernels, which Python calls, and their parts, which only kernels call.

A kernel is kept on disk. A part is compiled into the kernels that call it and has no interface of its own, which would
take longer to compile than the part itself; called from Python it is a plain function. Neither numba's cache nor a
kernel notices a change of these options, nor of a part in another file: delete ``__pycache__`` after one.
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.extending import register_jitable

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

kernel: Any = njit(**OPTIONS)
part: Any = register_jitable(error_model="numpy", no_cfunc_wrapper=True)

# A part that allocates nothing; the kernel that calls it holds its arrays. numba counts the references of every view of
# an array (``table[i]`` as an argument, say) by an atomic operation, which takes as long as some forty others; here
# it is compiled out, and a function that allocates is refused.
leaf: Any = register_jitable(error_model="numpy", no_cfunc_wrapper=True, _nrt=False)
# A leaf in which multiply and add are joined where the processor can: one rounding less, not one more.
contracted: Any = register_jitable(error_model="numpy", no_cfunc_wrapper=True, _nrt=False, fastmath={"contract"})
