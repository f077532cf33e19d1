"""The one jit policy of the project.

`cache` because a vehicle must not compile at every start; `nogil` because receiving and correcting run beside
the publisher; no `fastmath`, because live, replay and offline must agree in every bit; the `numpy` error model,
because a division by zero has to give a flagged non-finite number and not a raised exception inside the loop.
Tests run once more with `NUMBA_DISABLE_JIT=1`: kernels stay plain Python that numpy can execute.
"""

from typing import Any

import numba


def kernel(function: Any) -> Any:
    """Compile `function` under the project's policy (lazily, at its first call)."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)


def inlined(function: Any) -> Any:
    """Like `kernel`, for small helpers that are to be inlined into the kernel that calls them."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", inline="never")(function)
