"""rerun, imported late: our surfaces and streams need it, a vehicle does not."""

import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from rtcomp.errors import WorkError

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
    home = Path(tempfile.gettempdir()) / f"rtcomp-rerun-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    folder = home / "rerun"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    off = {"analytics_enabled": False, "analytics_id": "", "metadata": {}}
    (folder / "analytics.json").write_text(json.dumps(off), encoding="utf-8")
    return os.environ | {"XDG_CONFIG_HOME": str(home)}
