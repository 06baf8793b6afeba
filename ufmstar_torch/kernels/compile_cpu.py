"""Compiles code for the CPU (numba): kernels, which Python calls, and their parts, which only kernels call.

A kernel is kept on disk. A part is compiled into the kernels that call it and has no interface of its own; called from
Python it is a plain function.

This is the only file that touches numba's private parts (``tests/test_warm_up.py`` fails where numba changes them).
numba optimises each function on its own, makes machine code of it, and does both again in every function that calls
it. Here a part is optimised and made machine code only in its kernels; of numba's passes over a function those remain
that such plain code needs. A first start takes half the time for it.

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
from typing import Any, cast

import numba
from numba import njit, types
from numba.core import caching, cgutils, codegen, compiler, typed_passes, untyped_passes
from numba.core.compiler_machinery import PassManager, register_pass
from numba.extending import intrinsic, register_jitable
from numba.np.arrayobj import get_itemsize, make_array, populate_array
from numpy.typing import NDArray

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.GenericRewrites,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
)


# Settings of a caller that change nothing in what it calls.
_OF_THE_CALLER = ("release_gil", "no_cpython_wrapper", "no_cfunc_wrapper")


class _Flags(compiler.Flags):
    """Settings of a compilation. numba compares them for every operator, to look up what it has compiled: equal where
    what is called is the same."""

    __slots__ = ("_compared",)

    def __hash__(self) -> int:
        return hash(_Flags)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Flags):
            return NotImplemented
        return self is other or self._values_of_interest() == other._values_of_interest()

    def _values_of_interest(self) -> list[Any]:
        if not hasattr(self, "_compared"):  # nothing changes any more
            self._compared = [value for name, value in self.values().items() if name not in _OF_THE_CALLER]
        return self._compared


class _Library(codegen.JITCodeLibrary):
    """LLVM's code of a kernel with its parts, which is optimised once."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class _PartLibrary(_Library):
    """LLVM's code of a part, for kernels to link."""

    def _optimize_final_module(self) -> None:
        """The kernel's optimisation is enough."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """A part raises no exception whose values are known at run time only."""


@register_pass(mutates_CFG=True, analysis_only=False)
class _KernelLowering(typed_passes.NativeLowering):
    _name = "ufmstar_kernel_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _Library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super().run_pass(state)


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(typed_passes.NativeLowering):
    _name = "ufmstar_part_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().run_pass(state)


class _Kernel(compiler.CompilerBase):
    """The passes over a kernel."""

    lowering: type[typed_passes.NativeLowering] = _KernelLowering

    def __init__(self, typingctx, targetctx, library, args, return_type, flags, locals) -> None:
        super().__init__(typingctx, targetctx, library, args, return_type, _Flags(flags), locals)

    def define_pipelines(self) -> list[PassManager]:
        manager = PassManager("ufmstar_torch")
        for one in (*_PASSES, self.lowering, typed_passes.NoPythonBackend):
            manager.add_pass(one, one.__name__)
        manager.finalize()
        return [manager]


class _Part(_Kernel):
    """The passes over a part."""

    lowering = _PartLowering


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


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile at the first call, and keep the result on disk; in memory alone where no folder can be written to."""

    def decorated(function: Callable[..., Any]) -> Any:
        settings = {**_OPTIONS, **options, "pipeline_class": _Kernel}
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
    return register_jitable(error_model="numpy", no_cfunc_wrapper=True, pipeline_class=_Part, **options)


kernel = cached()
part = _inner()

# A part that allocates nothing; the kernel that calls it holds its arrays. numba counts the references of every view of
# an array (``table[i]`` as an argument, say) by an atomic operation, which takes as long as some forty others; here
# it is compiled out, and a function that allocates is refused.
leaf = _inner(_nrt=False)
# A leaf in which multiply and add are joined where the processor can: one rounding less, not one more.
contracted = _inner(_nrt=False, fastmath={"contract"})

# A kernel and a leaf whose sums may be taken in any order, so that they run in vectors.
_ANY_ORDER = {"reassoc", "contract", "nsz"}
reordered = cached(fastmath=_ANY_ORDER)
reordered_leaf = _inner(_nrt=False, fastmath=_ANY_ORDER)


@intrinsic
def _empty(typing, shape, dtype):
    """``np.empty(shape, dtype)``, which itself takes .1 s to compile for every kind of array."""
    array = types.Array(dtype.dtype, len(shape) if isinstance(shape, types.BaseTuple) else 1, "C")
    return array(shape, dtype), _allocated


# As a type checker sees it from a kernel, where the typing context is not an argument.
empty: Callable[..., NDArray[Any]] = cast(Any, _empty)


def _allocated(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """A new array of the signature's type, whose shape is the first argument."""
    kind, shape = signature.return_type, signature.args[0]
    several = isinstance(shape, types.BaseTuple)
    unpacked = cgutils.unpack_tuple(builder, arguments[0]) if several else [arguments[0]]
    sizes = [
        context.cast(builder, size, of, types.intp)
        for size, of in zip(unpacked, shape.types if several else [shape], strict=True)
    ]
    itemsize = context.get_constant(types.intp, get_itemsize(context, kind))
    strides = [itemsize]
    for size in reversed(sizes):
        strides.insert(0, builder.mul(strides[0], size))
    align = context.get_constant(types.uint32, context.get_preferred_array_alignment(kind.dtype))
    memory = context.nrt.meminfo_alloc_aligned(builder, strides.pop(0), align)
    array, number = make_array(kind)(context, builder), context.get_value_type(types.intp)
    populate_array(
        array,
        data=builder.bitcast(context.nrt.meminfo_data(builder, memory), context.get_data_type(kind.dtype).as_pointer()),
        shape=cgutils.pack_array(builder, sizes, ty=number),
        strides=cgutils.pack_array(builder, strides, ty=number),
        itemsize=itemsize,
        meminfo=memory,
    )
    return array._getvalue()
