"""rerun, imported late: our surfaces and streams need it, a vehicle does not."""

import os
import shutil
import sys
from pathlib import Path
from typing import Any

from rtcomp.errors import WorkError
from rtcomp.model import write_document

APPLICATION = "rtcomp"
TIMELINE = "time"


def load_rerun() -> Any:
    """The rerun module.

    Raises WorkError when it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise WorkError(
            f"the viewer needs rerun, which cannot be imported ({error}); pip install rerun-sdk"
        ) from error
    return rerun


def rerun_program() -> str:
    """Path of the viewer program that comes with the package.

    Raises WorkError when it is not there.
    """
    name = "rerun.exe" if os.name == "nt" else "rerun"
    package = Path(load_rerun().__file__).resolve().parent.parent
    for program in (package / "rerun_cli" / name, Path(sys.executable).parent / name):
        if program.is_file():
            return str(program)
    found = shutil.which("rerun")
    if found is None:
        raise WorkError(
            "the program rerun is not installed beside its package; pip install --force-reinstall rerun-sdk"
        )
    return found


def quiet_environment() -> dict[str, str]:
    """The environment of a viewer we start: its usage analytics are off, whatever the user's own setting is.

    The program reads that switch from its configuration folder only, so ours gets a folder of its own (the SDK
    inside this process sends none).
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rtcomp" / "rerun-config"
    file = home / "rerun" / "analytics.json"
    off = {
        "analytics_enabled": False,
        "analytics_id": "off",
        "metadata": {},
        "config_file_path": str(file),
        "data_dir_path": str(file.parent),
    }
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkError(
            f"cannot switch rerun's analytics off in {file.parent}: {error.strerror}; set XDG_CACHE_HOME"
        ) from error
    write_document(off, file)
    return os.environ | {"XDG_CONFIG_HOME": str(home)}
