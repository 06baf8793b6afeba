"""Compiles code for the CPU (numba): kernels, which Python calls, and their parts, which only kernels call.

Kernels are cached on disk. A part is compiled into each kernel that calls it; called from Python it is a plain
function.

This is the only file that uses numba's private interfaces (``tests/test_warm_up.py`` fails where numba changes them).
numba optimises each function, makes machine code of it, and repeats both in every function that calls it. Here only
kernels are optimised and made machine code, together with their parts, and only those of numba's passes run that such
plain code needs. What numba has found out about a call's types is not found out again. This more than halves the time
of the first start.

A cached kernel is valid while its code, its parts and their constants are unchanged, wherever their files lie
(:func:`code_stamp`): numba itself compares the time of the kernel's file, and would use an outdated part. A damaged
file, or one that cannot be written, is reported once (logger ``ufmstar_torch``), and the kernel is compiled in memory.
"""

from __future__ import annotations

import copy
import functools
import hashlib
import inspect
import logging
import pickle
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, cast

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import njit, types
from numba.core import caching, cgutils, codegen, compiler, typed_passes, untyped_passes
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic as Intrinsic
from numba.extending import intrinsic, register_jitable
from numba.np.arrayobj import get_itemsize, make_array, populate_array
from numpy.typing import NDArray

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.GenericRewrites,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
)


# Flags of a caller that do not change the functions it calls.
_CALLER_FLAGS = ("release_gil", "no_cpython_wrapper", "no_cfunc_wrapper")


class _Flags(compiler.Flags):
    """Flags of a compilation. For every operator, numba looks up compiled code by comparing flags; this comparison
    leaves out ``_CALLER_FLAGS``."""

    __slots__ = ("_compared",)

    def __hash__(self) -> int:
        return hash(_Flags)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Flags):
            return NotImplemented
        return self is other or self._values_of_interest() == other._values_of_interest()

    def _values_of_interest(self) -> list[Any]:
        if not hasattr(self, "_compared"):  # the flags no longer change
            self._compared = [value for name, value in self.values().items() if name not in _CALLER_FLAGS]
        return self._compared


def _optimisation(generator: Any) -> tuple[Any, Any]:
    """LLVM's passes over a kernel, as numba chooses them, but no loop is unrolled or interleaved: the code is smaller,
    compiles a sixth faster, and is not slower."""
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.loop_unrolling, options.loop_interleaving = True, False, False
    builder = llvm.create_pass_builder(generator._tm, options)
    passes = builder.getModulePassManager()
    passes.add_refprune_pass()
    return passes, builder


class _Library(codegen.JITCodeLibrary):
    """LLVM's code of a kernel with its parts, each linked once, optimised once."""

    def add_linking_library(self, library: Any) -> None:
        parts = library._linking_libraries if isinstance(library, _PartLibrary) else []
        for needed in (library, *parts):  # in this order: LLVM drops a function that nothing uses yet
            if needed not in self._linking_libraries:
                super().add_linking_library(needed)

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        passes, builder = _optimisation(self._codegen)
        passes.run(self._final_module, builder)


class _PartLibrary(_Library):
    """LLVM's code of a part, which kernels link."""

    def finalize(self) -> None:
        """Leave linking and optimising to the kernels: they link a part's own parts too."""
        self._raise_if_finalized()
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: no part raises an exception with values of the run time."""


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


@functools.cache
def _call_type(typing: Any, function: Any, arguments: tuple[types.Type, ...]) -> Any:
    """The signature of a call. numba tries a dozen implementations for every use of an operator."""
    return typing.resolve_function_type(function, arguments, {})


class _Kernel(compiler.CompilerBase):
    """Compiler passes over a kernel."""

    lowering: type[typed_passes.NativeLowering] = _KernelLowering

    def __init__(self, typingctx, targetctx, library, args, return_type, flags, locals) -> None:
        super().__init__(typingctx, targetctx, library, args, return_type, _Flags(flags), locals)
        # Both contexts are this compilation's own, so that others are not changed.
        self.state.targetctx.refresh = functools.cache(self.state.targetctx.refresh)  # not once for each call
        self.state.typingctx = copy.copy(typingctx)
        self.state.typingctx.resolve_function_type = functools.partial(self._resolve, typingctx)

    @staticmethod
    def _resolve(typingctx: Any, function: Any, arguments: tuple[Any, ...], keywords: Mapping[str, Any]) -> Any:
        if keywords or not all(isinstance(x, types.Type) and x.is_precise() for x in arguments):
            return typingctx.resolve_function_type(function, arguments, keywords)
        return _call_type(typingctx, function, tuple(arguments))

    def define_pipelines(self) -> list[PassManager]:
        manager = PassManager("ufmstar_torch")
        for compiler_pass in (*_PASSES, self.lowering, typed_passes.NoPythonBackend):
            manager.add_pass(compiler_pass, compiler_pass.__name__)
        manager.finalize()
        return [manager]


class _Part(_Kernel):
    """Compiler passes over a part."""

    lowering = _PartLowering


def code_stamp(function: Callable[..., Any]) -> str:
    """Hash of everything that is compiled into a kernel: its code, the functions that it calls, and their constants.

    Comments, docstrings and other functions of the same files do not change it.

    Raises:
        TypeError: a kernel uses a global variable of another kind than a number, text, array, class, module or
            function.
    """
    digest, seen = hashlib.sha256(), set[Any]()

    def add(item: Any) -> None:
        digest.update(repr(item).encode())

    def visit_code(code: CodeType, names: Mapping[str, Any], docstring: str | None) -> None:
        add((code.co_code, code.co_names, code.co_varnames, code.co_freevars))
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                visit_code(constant, names, None)
            elif constant is not docstring and constant is not None:  # the docstring's place holds None without one
                add(sorted(constant, key=repr) if isinstance(constant, frozenset) else constant)
        for name in code.co_names:
            if name in names:
                visit(name, names[name])

    def visit(name: str, value: Any) -> None:
        if isinstance(value, Dispatcher):
            value = value.py_func
        if isinstance(value, FunctionType):
            if value not in seen:
                seen.add(value)
                add((_COMPILED_WITH.get(value), value.__module__))  # a cached kernel names the modules of its parts
                cells = [cell.cell_contents for cell in value.__closure__ or ()]
                names = {**value.__globals__, **dict(zip(value.__code__.co_freevars, cells, strict=True))}
                visit_code(value.__code__, names, value.__code__.co_consts[0] if value.__doc__ else None)
                for cell_name, cell in zip(value.__code__.co_freevars, cells, strict=True):
                    visit(cell_name, cell)
        elif isinstance(value, np.ndarray):
            add((name, value.dtype.str, value.shape, value.tobytes()))
        elif isinstance(value, type):
            add((name, value.__qualname__, getattr(value, "_fields", None)))
        elif isinstance(value, Intrinsic):
            add((name, Path(inspect.getfile(value._defn)).read_bytes()))  # what it is made with: ``cpu.vectors``
            for cell in value._defn.__closure__ or ():
                if isinstance(cell.cell_contents, FunctionType):  # which writes its instructions
                    visit(name, cell.cell_contents)
        elif isinstance(value, ModuleType | BuiltinFunctionType | np.ufunc):
            add((name, getattr(value, "__name__", "")))
        elif isinstance(value, int | float | str | tuple | np.generic | None):
            add((name, value))
        else:
            raise TypeError(f"{function.__qualname__} uses {name}, which no stamp covers: {type(value).__name__}")

    visit(function.__name__, function)
    return digest.hexdigest()


# Own code that changes how kernels are compiled, and the options of each part.
_COMPILER = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
_COMPILED_WITH: dict[Any, str] = {}


class _CacheFiles(caching.IndexDataCacheFile):
    """Cache files of a kernel: each holds a checksum, the kernel's stamp, and the content."""

    def __init__(self, path: str, function: Callable[..., Any]) -> None:
        module = Path(inspect.getfile(function)).stem
        name = f"{module}.{function.__qualname__}.py{sys.version_info[0]}{sys.version_info[1]}"
        super().__init__(path, name.replace("<", "").replace(">", ""), None)
        self._function = function

    @functools.cached_property
    def _stamp(self) -> tuple[str, str, str]:
        """Computed at the first use, when the functions that are defined below the kernel exist."""
        return numba.__version__, _COMPILER, code_stamp(self._function)

    def _load_index(self) -> dict[Any, str]:
        return self._read(self._index_path) or {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(self._index_path, overloads)

    def _load_data(self, name: str) -> Any:
        return self._read(self._data_path(name))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), data)

    def _read(self, path: str) -> Any:
        """The content of a file; None if it is missing, damaged or of another stamp."""
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
        return pickle.loads(content) if stamp == self._stamp else None

    def _write(self, path: str, content: Any) -> None:
        data = pickle.dumps((self._stamp, self._dump(content)))
        try:
            with self._open_for_write(path) as file:
                file.write(hashlib.sha256(data).digest() + data)
        except OSError as error:
            _report(f"{Path(path).parent} cannot be written to ({error.strerror})")


@functools.cache
def _report(reason: str) -> None:
    """Log once why kernels are compiled in memory."""
    logging.getLogger("ufmstar_torch").warning("compiled kernels: %s; compiling in memory", reason)


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile at the first call and cache the result on disk, or in memory where no folder can be written to."""

    def decorated(function: Callable[..., Any]) -> Any:
        settings = {**_OPTIONS, **options, "pipeline_class": _Kernel}
        try:
            compiled = njit(cache=True, **settings)(function)
        except RuntimeError:  # numba: "no locator available"
            return njit(**settings)(function)
        _COMPILED_WITH[function] = _described(options)
        cache = compiled._cache  # numba has no public way to add dependencies of a cached kernel
        cache._cache_file = _CacheFiles(cache._cache_path, function)
        return compiled

    return decorated


def on_disk(compiled: Any) -> bool:
    """True if another process could not spare this one to compile a kernel: it is compiled or on disk, or no folder can
    hold it."""
    return (
        bool(compiled.signatures)
        or compiled.stats.cache_path is None
        or bool(compiled._cache._cache_file._load_index())
    )


def _inner(**options: Any) -> Any:
    register = register_jitable(error_model="numpy", no_cfunc_wrapper=True, pipeline_class=_Part, **options)

    def decorated(function: Callable[..., Any]) -> Any:
        _COMPILED_WITH[function] = _described(options)
        return register(function)

    return decorated


def _described(options: Mapping[str, Any]) -> str:
    return repr(sorted((name, sorted(x) if isinstance(x, set) else x) for name, x in options.items()))


kernel = cached()
part = _inner()

# A part that allocates nothing; the kernel that calls it holds its arrays. numba counts references to every view of an
# array (such as ``table[i]`` as an argument) with an atomic operation, which takes as long as some forty others. A leaf
# counts no references, and numba refuses to compile one that allocates.
leaf = _inner(_nrt=False)
# A leaf with fused multiply-add where the processor has it: one rounding less.
contracted = _inner(_nrt=False, fastmath={"contract"})

# A kernel, a part and a leaf whose sums may be reordered, so that they are vectorised.
_ANY_ORDER = {"reassoc", "contract", "nsz"}
reordered = cached(fastmath=_ANY_ORDER)
reordered_part = _inner(fastmath=_ANY_ORDER)
reordered_leaf = _inner(_nrt=False, fastmath=_ANY_ORDER)


@intrinsic
def _empty(typing, shape, dtype):
    """``np.empty(shape, dtype)``, whose own compilation takes 0.1 s for every type of array."""
    array = types.Array(dtype.dtype, len(shape) if isinstance(shape, types.BaseTuple) else 1, "C")
    return array(shape, dtype), _allocated


# Typed as kernels call it: without the typing context.
empty: Callable[..., NDArray[Any]] = cast(Any, _empty)


def _allocated(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """A new array of the signature's type, whose shape is the first argument."""
    kind, shape = signature.return_type, signature.args[0]
    several = isinstance(shape, types.BaseTuple)
    unpacked = cgutils.unpack_tuple(builder, arguments[0]) if several else [arguments[0]]
    sizes = [
        context.cast(builder, size, size_type, types.intp)
        for size, size_type in zip(unpacked, shape.types if several else [shape], strict=True)
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
