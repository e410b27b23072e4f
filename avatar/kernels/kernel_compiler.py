"""Compiles Python to machine code with numba, and gives kernels types of four and eight float32.

LLVM vectorises a loop over points, but not four numbers that are gathered and scattered, such as an
entry of the hash grid. As an explicit vector they make its kernels two to three times faster. Eight
are a register of AVX; products of small matrices keep their sums in them.
"""

import functools
import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.core.types import Type, float32, intp, none
from numba.extending import intrinsic, models, register_model

FAST_MATH: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "nogil": True}
"""Kernel options: sums may be reordered, division by zero does not raise, the GIL is released."""
NO_ALLOCATION: dict[str, Any] = {**FAST_MATH, "_nrt": False}
"""Kernel options without allocation: arrays are not reference-counted. The counting is atomic and
takes half of the time where arrays pass from one small kernel to the next."""
INLINED: dict[str, Any] = {**NO_ALLOCATION, "forceinline": True, "no_cpython_wrapper": True}
"""Options of a kernel that others call. LLVM inlines it: numba's own inlining types its statements
again in every caller, which takes a third of the time that compilation does. Python must not call
it, and would crash: a wrapper for that takes as long as a small kernel."""
INLINED_ALLOCATION: dict[str, Any] = {**FAST_MATH, "forceinline": True, "no_cpython_wrapper": True}
"""Options of such a kernel that allocates."""


def compile_kernel(
    *, cache: bool = True, **options: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorates a kernel: `numba.njit(**options)` with the machine code cached on disk.

    Shape-checking hooks wrap every function of a module under test, and numba cannot compile the
    wrapper, so the function is unwrapped first. Numba invalidates its cache when the function's own
    file changes, but not when a kernel that it calls does; the cache is therefore stamped with the
    sources of the kernel's folder and of the avatar's kernels. Where neither the folder nor
    the home folder is writable, every process compiles again.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        plain = inspect.unwrap(function)
        njit = functools.partial(numba.njit, no_cfunc_wrapper=True, **options)
        try:
            kernel = njit(cache=cache)(plain)
        except RuntimeError:  # "no locator available": no place to keep it
            kernel = njit()(plain)
        file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = _source_digest(Path(plain.__code__.co_filename).resolve().parent)
        return kernel

    return decorate


@functools.cache
def _source_digest(folder: Path) -> str:
    """Digest of every source that a kernel in a folder may be compiled from."""
    digest = hashlib.sha256()
    # kernels in any folder may use those of this one
    for path in sorted({*folder.glob("*.py"), *Path(__file__).resolve().parent.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


FAST_MATH_FLAGS = ("fast",)
"""LLVM flags of `FAST_MATH`: a product and a sum may become one instruction."""


class FloatVector(Type):
    """Numba's type of several float32 side by side."""

    def __init__(self, lanes: int) -> None:
        """The type of `lanes` numbers."""
        super().__init__(name=f"FloatVector{lanes}")
        self.ir_type = ir.VectorType(ir.FloatType(), lanes)


@register_model(FloatVector)
class _FloatVectorModel(models.PrimitiveModel):
    """Data model of a `FloatVector`: LLVM's vector."""

    def __init__(self, data_model_manager, numba_type):
        super().__init__(data_model_manager, numba_type, numba_type.ir_type)


vector4, vector8 = FloatVector(4), FloatVector(8)


def operation(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorates an operation of compiled code, which is called without the typing context."""
    return intrinsic(function)


def _item_pointer(context, builder, signature, arguments, ir_type):
    """Pointer to the numbers of an LLVM type that begin at `array[row, column]`."""
    array_type = signature.args[0]
    array = context.make_array(array_type)(context, builder, arguments[0])
    pointer = cgutils.get_item_pointer(
        context, builder, array_type, array, arguments[1:3], wraparound=False
    )
    return builder.bitcast(pointer, ir_type.as_pointer())


def _broadcast(builder, number, lanes):
    """A vector of one number, `lanes` times."""
    nothing = ir.Constant(ir.VectorType(ir.FloatType(), lanes), ir.Undefined)
    first = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    start = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(start, nothing, first)


def _load(vector, array):
    def code(context, builder, signature, arguments):
        place = _item_pointer(context, builder, signature, arguments, vector.ir_type)
        return builder.load(place, align=4)

    return vector(array, intp, intp), code


def _store(vector, array):
    def code(context, builder, signature, arguments):
        place = _item_pointer(context, builder, signature, arguments, vector.ir_type)
        builder.store(arguments[3], place, align=4)
        return context.get_dummy_value()

    return none(array, intp, intp, vector), code


@operation
def claim(typing_context, counter):
    """Returns `counter[0]`, the number of a block, and adds `counter[1]` to it in one operation.

    No two threads that share a counter claim the same block (`run_blocks`).
    """

    def code(context, builder, signature, arguments):
        array = context.make_array(counter)(context, builder, arguments[0])
        index = context.get_value_type(intp)
        stride = builder.load(builder.gep(array.data, [ir.Constant(index, 1)]))
        return builder.atomic_rmw("add", array.data, stride, "monotonic")

    return intp(counter), code


@operation
def load4(typing_context, array, row, column):
    """`array[row, column : column + 4]`; row and column are not negative, and not checked."""
    return _load(vector4, array)


@operation
def store4(typing_context, array, row, column, values):
    """`array[row, column : column + 4] = values`; row and column are not checked."""
    return _store(vector4, array)


@operation
def load8(typing_context, array, row, column):
    """`array[row, column : column + 8]`; row and column are not negative, and not checked."""
    return _load(vector8, array)


@operation
def store8(typing_context, array, row, column, values):
    """`array[row, column : column + 8] = values`; row and column are not checked."""
    return _store(vector8, array)


@operation
def repeat8(typing_context, array, row, column):
    """`array[row, column]`, eight times; row and column are not checked."""

    def code(context, builder, signature, arguments):
        place = _item_pointer(context, builder, signature, arguments, ir.FloatType())
        return _broadcast(builder, builder.load(place, align=4), 8)

    return vector8(array, intp, intp), code


@operation
def zeros8(typing_context):
    """Eight zeros."""

    def code(context, builder, signature, arguments):
        return ir.Constant(vector8.ir_type, [0.0] * 8)

    return vector8(), code


@operation
def multiply_add8(typing_context, one, other, total):
    """`one * other + total`."""

    def code(context, builder, signature, arguments):
        product = builder.fmul(*arguments[:2], flags=FAST_MATH_FLAGS)
        return builder.fadd(product, arguments[2], flags=FAST_MATH_FLAGS)

    return vector8(vector8, vector8, vector8), code


@operation
def where_positive8(typing_context, condition, values):
    """`values` where `condition` is above 0, and 0 elsewhere."""

    def code(context, builder, signature, arguments):
        zero = ir.Constant(vector8.ir_type, [0.0] * 8)
        return builder.select(builder.fcmp_ordered(">", arguments[0], zero), arguments[1], zero)

    return vector8(vector8, vector8), code


@operation
def sum8(typing_context, values):
    """The sum of the eight numbers."""

    def code(context, builder, signature, arguments):
        values, lanes = arguments[0], 8
        while lanes > 1:
            lanes //= 2
            low, high = (
                builder.shuffle_vector(
                    values, values,
                    ir.Constant(ir.VectorType(ir.IntType(32), lanes), list(range(n, n + lanes))),
                )
                for n in (0, lanes)
            )  # fmt: skip
            values = builder.fadd(low, high, flags=FAST_MATH_FLAGS)
        return builder.extract_element(values, ir.Constant(ir.IntType(32), 0))

    return float32(vector8), code


@operation
def prefetch(typing_context, array, row, column):
    """Has the cache fetch `array[row, column]` for a later read; neither is checked."""

    def code(context, builder, signature, arguments):
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        fetch = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [byte, number, number, number]),
            "llvm.prefetch.p0",
        )
        place = _item_pointer(context, builder, signature, arguments, ir.IntType(8))
        builder.call(fetch, [place, *(ir.Constant(number, n) for n in (0, 3, 1))])
        return context.get_dummy_value()

    return none(array, intp, intp), code


@operation
def scale4(typing_context, factor, values):
    """`factor * values`."""

    def code(context, builder, signature, arguments):
        factors = _broadcast(builder, arguments[0], 4)
        return builder.fmul(factors, arguments[1], flags=FAST_MATH_FLAGS)

    return vector4(float32, vector4), code


@operation
def add4(typing_context, one, other):
    """`one + other`."""

    def code(context, builder, signature, arguments):
        return builder.fadd(*arguments, flags=FAST_MATH_FLAGS)

    return vector4(vector4, vector4), code


@operation
def dot4(typing_context, one, other):
    """The sum of the products."""

    def code(context, builder, signature, arguments):
        product = builder.fmul(*arguments, flags=FAST_MATH_FLAGS)
        a, b, c, d = (
            builder.extract_element(product, ir.Constant(ir.IntType(32), lane)) for lane in range(4)
        )
        pairs = builder.fadd(a, c, flags=FAST_MATH_FLAGS), builder.fadd(b, d, flags=FAST_MATH_FLAGS)
        return builder.fadd(*pairs, flags=FAST_MATH_FLAGS)

    return float32(vector4, vector4), code
