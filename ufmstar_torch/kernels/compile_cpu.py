"""Compiles code for the CPU (numba): kernels, which Python calls, and their parts, which only kernels call.

A kernel is kept on disk. A part is compiled into the kernels that call it and has no interface of its own; called from
Python it is a plain function.

This is the only file that touches numba's private parts, those of its cache (``tests/test_warm_up.py`` fails where
numba changes them).

A kernel on disk counts as long as its own file and those whose code and constants are compiled into kernels are the
same: by itself numba looks at the first alone, and would go on with an outdated part. A damaged file, or one that
cannot be written, is reported once (logger ``ufmstar_torch``), and the kernel is compiled in memory.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit
from numba.core import caching
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


class _KeptFiles(caching.IndexDataCacheFile):
    """The files of a kernel on disk. Each is a checksum, the stamp of what the kernel depends on, and the content."""

    def _load_index(self) -> dict[Any, str]:
        return self._read(self._index_path) or {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(self._index_path, overloads)

    def _load_data(self, name: str) -> Any:
        return self._read(self._data_path(name))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), data)

    def _read(self, path: str) -> Any:
        """The content of a file, None where there is none of this stamp."""
        try:
            data = Path(path).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            return _report(f"{Path(path).parent} cannot be read ({error.strerror})")
        checksum, data = data[:32], data[32:]
        if hashlib.sha256(data).digest() != checksum:
            return _report(f"a file in {Path(path).parent} is damaged and is replaced")
        stamp, content = pickle.loads(data)
        return pickle.loads(content) if stamp == self._source_stamp else None

    def _write(self, path: str, content: Any) -> None:
        data = pickle.dumps((self._source_stamp, self._dump(content)))
        try:
            with self._open_for_write(path) as file:
                file.write(hashlib.sha256(data).digest() + data)
        except OSError as error:
            _report(f"{Path(path).parent} cannot be written to ({error.strerror})")


@functools.cache
def _report(what: str) -> None:
    """Log once that a kernel has to be compiled in memory."""
    logging.getLogger("ufmstar_torch").warning("compiled kernels: %s; compiling in memory", what)


def kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile at the first call, and keep the result on disk; in memory alone where no folder can be written to."""

    def decorated(function: Callable[..., Any]) -> Any:
        settings = {**_OPTIONS, **options}
        try:
            compiled = njit(cache=True, **settings)(function)
        except RuntimeError:  # numba: "no locator available"
            return njit(**settings)(function)
        cache = compiled._cache  # no public way to widen what a cached kernel depends on
        stamp = numba.__version__, cache._cache_file._source_stamp, _SOURCES
        cache._cache_file = _KeptFiles(cache._cache_path, f"{cache._impl.filename_base}.kept", stamp)
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
