"""Explicit vector instructions for compiled code (numba, LLVM), where LLVM does not vectorise Python's loops well.

In nested loops, LLVM keeps sums in memory, uses half of a vector where whole ones are as fast, and reduces one number
after the other. Here expressions work on vectors of 64 bytes. A processor with shorter vectors uses several for one.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16  # a multiple of the numbers in a vector, whatever their dtype
_BYTES = 64  # of a vector
_INDEX = ir.IntType(64)


class Lanes:
    """A vector of numbers or of truth values, with arithmetic operators.

    If ``flags`` allow it, a product and a sum become one instruction where the processor has it: one rounding less.
    """

    def __init__(self, builder: Any, value: Any, flags: tuple[str, ...]) -> None:
        self._builder, self.value, self._flags = builder, value, flags

    def _other(self, other: Lanes | float) -> Any:
        kind = self.value.type
        return other.value if isinstance(other, Lanes) else ir.Constant(kind, [other] * kind.count)

    def _new(self, value: Any) -> Lanes:
        return Lanes(self._builder, value, self._flags)

    def __add__(self, other: Lanes | float) -> Lanes:
        return self._new(self._builder.fadd(self.value, self._other(other), flags=self._flags))

    def __sub__(self, other: Lanes | float) -> Lanes:
        return self._new(self._builder.fsub(self.value, self._other(other), flags=self._flags))

    def __mul__(self, other: Lanes | float) -> Lanes:
        return self._new(self._builder.fmul(self.value, self._other(other), flags=self._flags))

    def __gt__(self, other: Lanes | float) -> Lanes:
        return self._new(self._builder.fcmp_ordered(">", self.value, self._other(other)))

    def select(self, yes: Lanes, no: Lanes | float) -> Lanes:
        """``yes`` where these truth values are True, else ``no``."""
        return self._new(self._builder.select(self.value, yes.value, yes._other(no)))

    def at_least(self, other: Lanes | float) -> Lanes:
        """Maximum; ``other`` for NaN."""
        return (self > other).select(self, other)

    def at_most(self, other: Lanes) -> Lanes:
        """Minimum; ``self`` for NaN."""
        return (self > other).select(other, self)

    def floats(self) -> Lanes:
        """The single-precision numbers of bytes."""
        kind = ir.VectorType(ir.FloatType(), self.value.type.count)
        return self._new(self._builder.uitofp(self.value, kind))

    def size(self) -> Lanes:
        """Absolute values."""
        return self.at_least(self * -1.0)

    def over(self, by: Lanes) -> Lanes:
        """The quotient."""
        return self._new(self._builder.fdiv(self.value, by.value))

    def everywhere(self, choose: Callable[[Lanes, Lanes], Lanes]) -> Lanes:
        """The reduction of all numbers by ``choose``, such as ``Lanes.at_most``, in every lane."""
        value, n = self, self.value.type.count
        while (n := n // 2) > 0:
            count = self.value.type.count
            rotated = ir.Constant(ir.VectorType(ir.IntType(32), count), [(i + n) % count for i in range(count)])
            value = choose(value, self._new(self._builder.shuffle_vector(value.value, value.value, rotated)))
        return value

    def exp2(self) -> Lanes:
        """2^t for t < 127, and at least 2^-120 (doubles: 2^-1000): products with subnormal numbers take a hundred times
        as long.

        2^n 2^r with |r| <= 1/2 and the polynomial that interpolates 2^r at Chebyshev's nodes, off by 3e-7 (3e-15) of it
        with all rounding. Adding 1.5 2^23 (2^52) rounds to the integer n, in the last bits, from where a shift
        brings it to the exponent.
        """
        double = isinstance(self.value.type.element, ir.DoubleType)
        mantissa, degree, least = (52, 11, -1000.0) if double else (23, 5, -120.0)
        whole = ir.VectorType(ir.IntType(64 if double else 32), self.value.type.count)
        t, rounder = self.at_least(least), 1.5 * 2.0**mantissa
        n = t + rounder
        r = t - (n - rounder)
        fit = np.polynomial.Chebyshev.interpolate(np.exp2, degree, domain=[-0.5, 0.5])
        *lower, highest = fit.convert(kind=np.polynomial.Polynomial).coef.tolist()
        power = r * highest + lower.pop()
        while lower:
            power = power * r + lower.pop()
        b = self._builder
        exponent = b.shl(b.bitcast(n.value, whole), ir.Constant(whole, [mantissa] * whole.count))
        return self._new(b.bitcast(b.add(exponent, b.bitcast(power.value, whole)), self.value.type))


class Memory:
    """A contiguous array; indices count its numbers. A vector of bytes has as many numbers as one of floats."""

    def __init__(self, builder: Any, data: Any, flags: tuple[str, ...]) -> None:
        real = data.type.pointee
        self._flags = flags
        byte = isinstance(real, ir.IntType) and real.width == 8
        self._builder, self._data, self._size = (
            builder,
            data,
            8 if isinstance(real, ir.DoubleType) else 1 if byte else 4,
        )
        self._vector = ir.VectorType(real, LANES if byte else _BYTES // self._size)

    def _at(self, index: Any, offset: int) -> Any:
        index = _INDEX(index) if isinstance(index, int) else index
        return self._builder.gep(self._data, [self._builder.add(index, _INDEX(offset)) if offset else index])

    def _lanes(self, value: Any) -> Lanes:
        return Lanes(self._builder, value, self._flags)

    def load(self, index: Any, offset: int = 0) -> Lanes:
        """The vector from ``index + offset`` on."""
        value = self._builder.load(self._builder.bitcast(self._at(index, offset), self._vector.as_pointer()))
        value.align = self._size
        return self._lanes(value)

    def store(self, value: Lanes, index: Any, offset: int = 0) -> None:
        """Write a vector from ``index + offset`` on."""
        at = self._builder.bitcast(self._at(index, offset), self._vector.as_pointer())
        self._builder.store(value.value, at).align = self._size

    def _row(self, index: Any, width: int) -> Any:
        return self._builder.bitcast(self._at(index, 0), ir.VectorType(self._vector.element, width).as_pointer())

    def load_rows(self, starts: Sequence[Any], width: int) -> Lanes:
        """The vector of one or two rows of ``width`` numbers, which begin at ``starts``."""
        rows = [self._builder.load(self._row(start, width)) for start in starts]
        for row in rows:
            row.align = self._size
        order = ir.Constant(ir.VectorType(ir.IntType(32), self._vector.count), list(range(self._vector.count)))
        return self._lanes(self._builder.shuffle_vector(rows[0], rows[-1], order))

    def store_rows(self, value: Lanes, starts: Sequence[Any], width: int) -> None:
        """Write a vector as one or two rows of ``width`` numbers, which begin at ``starts``."""
        for i, start in enumerate(starts):
            order = ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(i * width, (i + 1) * width)))
            row = self._builder.shuffle_vector(value.value, value.value, order)
            self._builder.store(row, self._row(start, width)).align = self._size

    def one(self, index: Any, offset: int = 0) -> Lanes:
        """A single number in every lane of a vector."""
        undefined, first = ir.Constant(self._vector, ir.Undefined), ir.IntType(32)(0)
        filled = self._builder.insert_element(undefined, self._builder.load(self._at(index, offset)), first)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), self._vector.count), [0] * self._vector.count)
        return self._lanes(self._builder.shuffle_vector(filled, undefined, zeros))

    def whole(self, index: Any) -> Any:
        """A number of an array of int64, as an index of another array."""
        return self._builder.load(self._at(index, 0))

    def put(self, value: Lanes, index: Any) -> None:
        """Write the first number of a vector."""
        first = self._builder.extract_element(value.value, ir.IntType(32)(0))
        self._builder.store(first, self._at(index, 0))


class Code:
    """The instructions for functions of vectors.

    Attributes:
        lanes: numbers of a vector.
    """

    def __init__(self, builder: Any, lanes: int) -> None:
        self._builder, self.lanes = builder, lanes

    @contextmanager
    def loop(self, end: Any, step: int = 1) -> Iterator[Any]:
        """For i in range(0, end, step)."""
        with cgutils.for_range_slice(self._builder, _INDEX(0), end, _INDEX(step), inc=True) as (i, _):
            yield i

    def times(self, index: Any, factor: int) -> Any:
        """A product of integers."""
        return self._builder.mul(index, _INDEX(factor)) if factor else _INDEX(0)

    def plus(self, index: Any, more: Any) -> Any:
        """A sum of integers."""
        return self._builder.add(index, more)

    def when(self, condition: Any) -> Any:
        """A context whose code runs where the argument ``condition`` is True."""
        return self._builder.if_then(condition)

    def variable(self, value: Lanes) -> Variable:
        """A vector that changes in a loop and stays in a register."""
        return Variable(self._builder, value)


class Variable:
    """See :meth:`Code.variable`."""

    def __init__(self, builder: Any, value: Lanes) -> None:
        self._builder, self._slot = builder, cgutils.alloca_once_value(builder, value.value)
        self._like = value

    @property
    def value(self) -> Lanes:
        return self._like._new(self._builder.load(self._slot))

    @value.setter
    def value(self, value: Lanes) -> None:
        self._builder.store(value.value, self._slot)


def vectors(function: Callable[..., None], *, joined: bool = True) -> Any:
    """Make a function for compiled code from a function that writes vector instructions.

    ``function(code, ...)`` gets a :class:`Code`, and a :class:`Memory` for each contiguous array of one floating dtype;
    integers (int64) and truth values are LLVM's. It returns nothing.

    Args:
        function: the writer.
        joined: whether products and sums may become one instruction; otherwise each result has the bits of scalar code.
    """
    flags = ("contract",) if joined else ()

    def typed(typing: Any, *arguments: Any) -> Any:
        real = next(kind.dtype for kind in arguments if isinstance(kind, types.Array))
        lanes = _BYTES // (real.bitwidth // 8)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            wrapped = [
                Memory(builder, context.make_array(kind)(context, builder, value).data, flags)
                if isinstance(kind, types.Array)
                else value
                for kind, value in zip(signature.args, values, strict=True)
            ]
            function(Code(builder, lanes), *wrapped)
            return context.get_dummy_value()

        return types.void(*arguments), generate

    names = list(inspect.signature(function).parameters)[1:]
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("typing", *names)]
    described: Any = typed
    described.__signature__ = inspect.Signature(parameters)
    described.__name__, described.__doc__ = function.__name__, function.__doc__
    return intrinsic(described)
