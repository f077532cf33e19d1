"""The system calls of the receive and send paths, callable from compiled code without the GIL.

numba declares them as external symbols of the C library (unlike ctypes pointers these may be cached); with
the jit off the same names are ctypes functions. Addresses are plain integers.
"""

import ctypes
import os

from numba import types

from rtcomp.jit import hot_kernel

CLOCK_REALTIME, CLOCK_MONOTONIC, TIMER_ABSTIME = 0, 1, 1

if os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
    _libc = ctypes.CDLL(None, use_errno=True)

    def _function(name, *arguments):
        function = getattr(_libc, name)
        function.argtypes = arguments
        function.restype = ctypes.c_int
        return function

    _int, _pointer, _long = ctypes.c_int, ctypes.c_void_p, ctypes.c_ulong
    last_error = ctypes.get_errno
else:
    _int, _pointer, _long = types.int32, types.uintp, types.uintp

    def _function(name, *arguments):
        return types.ExternalFunction(name, types.int32(*arguments))

    _errno_location = types.ExternalFunction("__errno_location", types.CPointer(types.int32)())

    @hot_kernel
    def last_error():
        """The calling thread's errno."""
        return _errno_location()[0]


poll = _function("poll", _pointer, _long, _int)
recvmmsg = _function("recvmmsg", _int, _pointer, _int, _int, _pointer)
sendmmsg = _function("sendmmsg", _int, _pointer, _int, _int)
clock_gettime = _function("clock_gettime", _int, _pointer)
clock_nanosleep = _function("clock_nanosleep", _int, _int, _pointer, _pointer)
getsockopt = _function("getsockopt", _int, _int, _int, _pointer, _pointer)
write = _function("write", _int, _pointer, _long)
