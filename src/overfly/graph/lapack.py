"""BLAS and LAPACK for compiled kernels, with leading dimensions, which numba's own ``np.dot`` cannot express.

The routines are those inside SciPy (scipy.linalg.cython_blas and cython_lapack); their addresses reach a
kernel as an argument, so that the compiled kernel can be cached between runs. Everything is column major,
lower triangle, float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import get_cython_function_address, intrinsic

from overfly.types import IntArray

POTRF, TRSM, SYRK, GEMM, GEMV, TRSV = range(6)


def addresses() -> IntArray:
    """(6,) addresses of dpotrf, dtrsm, dsyrk, dgemm, dgemv and dtrsv, to be passed to kernels."""
    return np.array(
        [
            get_cython_function_address("scipy.linalg.cython_lapack", "dpotrf"),
            get_cython_function_address("scipy.linalg.cython_blas", "dtrsm"),
            get_cython_function_address("scipy.linalg.cython_blas", "dsyrk"),
            get_cython_function_address("scipy.linalg.cython_blas", "dgemm"),
            get_cython_function_address("scipy.linalg.cython_blas", "dgemv"),
            get_cython_function_address("scipy.linalg.cython_blas", "dtrsv"),
        ],
        dtype=np.int64,
    )


@intrinsic
def _fortran_call(_typing_context: Any, _address: Any, arguments: Any) -> Any:
    """Call the routine at an address; uint64 arguments are pointers, everything else is passed by
    reference.
    """

    def generate(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        on_stack: Any = cgutils.alloca_once_value
        byte_pointer = ir.IntType(8).as_pointer()
        address, packed = values
        pointers = []
        for k, kind in enumerate(arguments.types):
            value = builder.extract_value(packed, k)
            if kind == types.uint64:
                pointers.append(builder.inttoptr(value, byte_pointer))
                continue
            if kind == types.int64:
                value = builder.trunc(value, ir.IntType(32))
            pointers.append(builder.bitcast(on_stack(builder, value), byte_pointer))
        signature = ir.FunctionType(ir.VoidType(), [byte_pointer] * len(pointers))
        builder.call(builder.inttoptr(address, signature.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(types.int64, arguments), generate


_call_fortran: Any = _fortran_call  # to a type checker an intrinsic still takes its typing context


_RIGHT, _LEFT, _LOWER, _PLAIN, _TRANSPOSED, _NOT_UNIT = (np.uint8(ord(letter)) for letter in "RLLNTN")


@njit(nogil=True)
def _at(array: Any, offset: int) -> Any:
    """Address of element ``offset`` of a float64 array."""
    return np.uint64(array.ctypes.data) + np.uint64(8 * offset)


@njit(nogil=True)
def _cholesky_in_place(routines: Any, n: int, a: Any, lda: int, failed: Any) -> None:
    """Lower Cholesky factor of the n x n matrix at address a; failed[0] > 0 where it is not positive
    definite.
    """
    _call_fortran(
        routines[POTRF],
        (_LOWER, np.int64(n), a, np.int64(lda), np.uint64(failed.ctypes.data)),
    )


@njit(nogil=True)
def _solve_right_transposed(routines: Any, m: int, n: int, factor: Any, ldf: int, b: Any, ldb: int) -> None:
    """B <- B L^-T, B m x n."""
    _call_fortran(
        routines[TRSM],
        (
            _RIGHT,
            _LOWER,
            _TRANSPOSED,
            _NOT_UNIT,
            np.int64(m),
            np.int64(n),
            1.0,
            factor,
            np.int64(ldf),
            b,
            np.int64(ldb),
        ),
    )


@njit(nogil=True)
def _solve_right(routines: Any, m: int, n: int, factor: Any, ldf: int, b: Any, ldb: int) -> None:
    """B <- B L^-1, B m x n."""
    _call_fortran(
        routines[TRSM],
        (
            _RIGHT,
            _LOWER,
            _PLAIN,
            _NOT_UNIT,
            np.int64(m),
            np.int64(n),
            1.0,
            factor,
            np.int64(ldf),
            b,
            np.int64(ldb),
        ),
    )


@njit(nogil=True)
def _subtract_square(routines: Any, n: int, k: int, a: Any, lda: int, c: Any, ldc: int) -> None:
    """Lower triangle of C <- C - A A^T, A n x k."""
    _call_fortran(
        routines[SYRK],
        (_LOWER, _PLAIN, np.int64(n), np.int64(k), -1.0, a, np.int64(lda), 1.0, c, np.int64(ldc)),
    )


@njit(nogil=True)
def _subtract_product(
    routines: Any,
    m: int,
    n: int,
    k: int,
    a: Any,
    lda: int,
    b: Any,
    ldb: int,
    c: Any,
    ldc: int,
    transpose_a: bool,
) -> None:
    """C <- C - op(A) B, C m x n, inner dimension k, op(A) = A^T if transpose_a."""
    letter = _TRANSPOSED if transpose_a else _PLAIN
    _call_fortran(
        routines[GEMM],
        (
            letter,
            _PLAIN,
            np.int64(m),
            np.int64(n),
            np.int64(k),
            -1.0,
            a,
            np.int64(lda),
            b,
            np.int64(ldb),
            1.0,
            c,
            np.int64(ldc),
        ),
    )


@njit(nogil=True)
def _subtract_transposed_times(routines: Any, m: int, n: int, a: Any, lda: int, x: Any, y: Any) -> None:
    """y <- y - A^T x, A m x n."""
    one = np.int64(1)
    _call_fortran(
        routines[GEMV],
        (_TRANSPOSED, np.int64(m), np.int64(n), -1.0, a, np.int64(lda), x, one, 1.0, y, one),
    )


@njit(nogil=True)
def _solve_transposed(routines: Any, n: int, factor: Any, ldf: int, x: Any) -> None:
    """x <- L^-T x."""
    _call_fortran(
        routines[TRSV],
        (_LOWER, _TRANSPOSED, _NOT_UNIT, np.int64(n), factor, np.int64(ldf), x, np.int64(1)),
    )
