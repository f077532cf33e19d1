"""Importing python-can without what only its .mf4 reader needs.

`import can` loads asammdf, and with it pandas, wherever that is installed: most of a second that a vehicle's
start does not have. So asammdf is hidden while python-can loads, and let in when an .mf4 log is read.
"""

import importlib
import sys
from types import ModuleType
from typing import Any


def import_can() -> ModuleType:
    """The `can` package; loaded without asammdf if it was not loaded before."""
    if "can" not in sys.modules and "asammdf" not in sys.modules:
        sys.modules["asammdf"] = None  # pyright: ignore[reportArgumentType] (this makes its import fail)
        try:
            return importlib.import_module("can")
        finally:
            del sys.modules["asammdf"]
    return importlib.import_module("can")


def mf4_reader() -> Any:
    """python-can's MF4Reader class, with asammdf. Raises ImportError where that is not installed."""
    importlib.import_module("asammdf")
    module = importlib.import_module("can.io.mf4")
    if getattr(module, "asammdf", None) is None:
        module = importlib.reload(module)
    return module.MF4Reader
