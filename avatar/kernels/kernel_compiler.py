"""Compiles Python to machine code with numba, and gives kernels a type of four float32.

LLVM vectorises a loop over points, but not four numbers that are gathered and scattered, such as an
entry of the hash grid. As an explicit vector they make its kernels two to three times faster.
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
CALLEE_FOLDER = Path(__file__).resolve().parent
"""Folder whose kernels and constants kernels in any folder may use."""
NO_ALLOCATION: dict[str, Any] = {**FAST_MATH, "_nrt": False}
"""Kernel options without allocation: arrays are not reference-counted. The counting is atomic and
takes half of the time where arrays pass from one small kernel to the next."""


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
        try:
            kernel = numba.njit(cache=cache, **options)(plain)
        except RuntimeError:  # "no locator available": no place to keep it
            kernel = numba.njit(**options)(plain)
        file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = _source_digest(Path(plain.__code__.co_filename).resolve().parent)
        return kernel

    return decorate


@functools.cache
def _source_digest(folder: Path) -> str:
    """Digest of every source that a kernel in a folder may be compiled from."""
    digest = hashlib.sha256()
    for path in sorted({*folder.glob("*.py"), *CALLEE_FOLDER.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


FAST_MATH_FLAGS = ("fast",)
"""LLVM flags of `FAST_MATH`: a product and a sum may become one instruction."""
FLOAT4 = ir.VectorType(ir.FloatType(), 4)


class Vector4(Type):
    """Numba's type of four float32 side by side."""

    def __init__(self) -> None:
        """The one type of this class."""
        super().__init__(name="Vector4")


@register_model(Vector4)
class _Vector4Model(models.PrimitiveModel):
    """Data model of a `Vector4`: LLVM's vector."""

    def __init__(self, data_model_manager, numba_type):
        super().__init__(data_model_manager, numba_type, FLOAT4)


vector4 = Vector4()


def operation(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorates an operation of compiled code, which is called without the typing context."""
    return intrinsic(function)


def _row_pointer(context, builder, signature, arguments):
    """Pointer to the four numbers that begin at `array[row, column]`."""
    array_type = signature.args[0]
    array = context.make_array(array_type)(context, builder, arguments[0])
    pointer = cgutils.get_item_pointer(
        context, builder, array_type, array, arguments[1:3], wraparound=False
    )
    return builder.bitcast(pointer, FLOAT4.as_pointer())


def _broadcast(builder, number):
    """A vector of one number four times."""
    nothing = ir.Constant(FLOAT4, ir.Undefined)
    first = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0, 0, 0, 0])
    start = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(start, nothing, first)


@operation
def load4(typing_context, array, row, column):
    """`array[row, column : column + 4]`; row and column are not negative, and not checked."""

    def code(context, builder, signature, arguments):
        return builder.load(_row_pointer(context, builder, signature, arguments), align=4)

    return vector4(array, intp, intp), code


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
        place = builder.bitcast(_row_pointer(context, builder, signature, arguments), byte)
        builder.call(fetch, [place, *(ir.Constant(number, n) for n in (0, 3, 1))])
        return context.get_dummy_value()

    return none(array, intp, intp), code


@operation
def store4(typing_context, array, row, column, values):
    """`array[row, column : column + 4] = values`; row and column are not checked."""

    def code(context, builder, signature, arguments):
        builder.store(arguments[3], _row_pointer(context, builder, signature, arguments), align=4)
        return context.get_dummy_value()

    return none(array, intp, intp, vector4), code


@operation
def scale4(typing_context, factor, values):
    """`factor * values`."""

    def code(context, builder, signature, arguments):
        return builder.fmul(_broadcast(builder, arguments[0]), arguments[1], flags=FAST_MATH_FLAGS)

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
