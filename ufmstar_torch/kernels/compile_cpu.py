"""How code for the CPU is compiled (numba): kernels, which Python calls, and their parts, which only kernels call.

A kernel is kept on disk. A part is compiled into the kernels that call it and has no interface of its own, which would
take longer to compile than the part itself; called from Python it is a plain function.

A kernel on disk counts as long as its own file and those whose code and constants are compiled into kernels are the
same: by itself numba looks at the first alone, and would go on with an outdated part.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.extending import register_jitable

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _sources() -> str:
    """Hash of the files whose code and constants are compiled into kernels."""
    core, digest = Path(__file__).parents[1], hashlib.sha256()
    for folder in (core, core / "kernels", core / "posterior"):
        for file in sorted(folder.glob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


_SOURCES = _sources()


def kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile at the first call, and keep the result on disk; in memory alone where no folder can be written to."""

    def decorated(function: Callable[..., Any]) -> Any:
        try:
            compiled = njit(cache=True, **_OPTIONS, **options)(function)
        except RuntimeError:  # numba: "no locator available"
            return njit(**_OPTIONS, **options)(function)
        file = compiled._cache._cache_file  # no public way to widen what a cached kernel depends on
        file._source_stamp = (file._source_stamp, _SOURCES)
        return compiled

    return decorated


def _inner(**options: Any) -> Any:
    return register_jitable(error_model="numpy", no_cfunc_wrapper=True, **options)


kernel = kept()
part = _inner()

# A part that allocates nothing; the kernel that calls it holds its arrays. numba counts the references of every view of
# an array (``table[i]`` as an argument, say) by an atomic operation, which takes as long as some forty others; here
# it is compiled out, and a function that allocates is refused.
leaf = _inner(_nrt=False)
# A leaf in which multiply and add are joined where the processor can: one rounding less, not one more.
contracted = _inner(_nrt=False, fastmath={"contract"})

# A kernel and a leaf whose sums may be taken in any order, so that they run in vectors.
_ANY_ORDER = {"reassoc", "contract", "nsz"}
reordered = kept(fastmath=_ANY_ORDER)
reordered_leaf = _inner(_nrt=False, fastmath=_ANY_ORDER)
