"""The one jit policy of the project.

`cache`, because a vehicle must not compile at every start; `nogil`, because receiving and correcting run beside
the publisher; no `fastmath`, because live, replay and offline must agree in every bit; the `numpy` error model,
because a division by zero has to give a flagged non-finite number and not an exception inside the loop.
Tests run once more with `NUMBA_DISABLE_JIT=1`: kernels stay plain Python that numpy can execute.
"""

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

PACKAGES = Path(__file__).parents[1]
MENTION = b"rtcomp.jit"


def _compiled(function: Any, **options: Any) -> Any:
    """`numba.njit` with the policy, and a cache that knows of every kernel's source.

    numba takes an entry of its cache for fresh when the function's own file is; a kernel that calls one of another
    file would stay what it was when that is edited or upgraded, and an entry that mentions a class which has moved
    could not even be read. So what numba compares first, its version, also tells the state of all kernels.
    """
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    if isinstance(compiled, Dispatcher):  # a plain function with NUMBA_DISABLE_JIT
        cache: Any = vars(compiled)["_cache"]
        index = cache._cache_file
        index._version = f"{index._version} {_kernel_sources(function.__module__.partition('.')[0])}"
    return compiled


@lru_cache(maxsize=4)
def _kernel_sources(package: str) -> str:
    """The state of all files with kernels that a function of `package` may call."""
    state = hashlib.sha256()
    for folder in sorted({"rtcomp", package}):
        for path in sorted((PACKAGES / folder).rglob("*.py")):
            content = path.read_bytes()
            if MENTION in content:
                state.update(content)
    return state.hexdigest()


def kernel(function: Any) -> Any:
    """Compile `function` lazily, at its first call; it may create arrays."""
    return _compiled(function)


def hot_kernel(function: Any) -> Any:
    """Compile a function of the way from frame to corrected sample; it must not create arrays.

    Model and state are tuples of arrays. Without numba's runtime (`_nrt=False`) no reference is counted to each of
    them at every call, which measured 730 ns a sample against 76 ns; the option also refuses any allocation there.
    """
    options: dict[str, Any] = {"forceinline": True, "_nrt": False}
    return _compiled(function, **options)


def rare_kernel(function: Any) -> Any:
    """Compile a function of the same way that few frames take: called and not copied, which keeps the others short.

    Give it numbers and single arrays: a model or a state goes over field by field, which costs more than it saves.
    """
    options: dict[str, Any] = {"_nrt": False}
    return _compiled(function, **options)


def sum_kernel(function: Any) -> Any:
    """Compile a sum over many samples at a desk: its terms may be added in any order, many at a time.

    For training only, where sums over whole recordings go through such kernels or BLAS, which does the same.
    """
    return _compiled(function, fastmath={"reassoc"})
