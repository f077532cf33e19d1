"""The one jit policy of the project.

`cache`, because a vehicle must not compile at every start; `nogil`, because receiving and correcting run beside
the publisher; no `fastmath`, because live, replay and offline must agree in every bit; the `numpy` error model,
because a division by zero has to give a flagged non-finite number and not an exception inside the loop.
Tests run once more with `NUMBA_DISABLE_JIT=1`: kernels stay plain Python that numpy can execute.
"""

from typing import Any

import numba


def kernel(function: Any) -> Any:
    """Compile `function` lazily, at its first call; it may create arrays."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)


def hot_kernel(function: Any) -> Any:
    """Compile a function of the way from frame to corrected sample; it must not create arrays.

    Model and state are tuples of arrays. Without numba's runtime (`_nrt=False`) no reference is counted to each of
    them at every call, which measured 730 ns a sample against 76 ns; the option also refuses any allocation there.
    """
    options: dict[str, Any] = {"forceinline": True, "_nrt": False}
    return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)


def rare_kernel(function: Any) -> Any:
    """Compile a function of the same way that few frames take: called and not copied, which keeps the others short.

    Give it numbers and single arrays: a model or a state goes over field by field, which costs more than it saves.
    """
    options: dict[str, Any] = {"_nrt": False}
    return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)


def sum_kernel(function: Any) -> Any:
    """Compile a sum over many samples at a desk: its terms may be added in any order, many at a time.

    For training only, where sums over whole recordings go through such kernels or BLAS, which does the same.
    """
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc"})(function)
