"""The compiled kernels on disk: fresh when every kernel's source is, and never in the way of an upgrade."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

CALLER = """
from rtcomp.callee import inner
from rtcomp.jit import kernel

@kernel
def outer(x):
    return inner(x)
"""
CALLEE = "from rtcomp.jit import kernel\n\n@kernel\ndef inner(x):\n    return x + {}\n"


@pytest.fixture
def package(tmp_path):
    """A package of two modules with the policy of `rtcomp.jit`; the function calls it in a process of its own."""
    folder = tmp_path / "rtcomp"
    folder.mkdir()
    shutil.copy(Path("rtcomp/jit.py"), folder)
    (folder / "__init__.py").touch()
    (folder / "caller.py").write_text(CALLER)
    (folder / "callee.py").write_text(CALLEE.format(1))
    environment = {
        k: v for k, v in os.environ.items() if k not in ("NUMBA_DISABLE_JIT", "NUMBA_CACHE_DIR", "PYTHONPATH")
    }

    def outer_of_one():
        code = "from rtcomp.caller import outer; print(outer(1), sum(outer.stats.cache_hits.values()))"
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
        return [int(word) for word in done.stdout.split()]

    return folder, outer_of_one


def test_a_kernel_follows_its_callee_in_another_file(package):
    folder, outer_of_one = package
    assert outer_of_one() == [2, 0]
    assert outer_of_one() == [2, 1]
    (folder / "callee.py").write_text(CALLEE.format(10))
    assert outer_of_one() == [11, 0]
    (folder / "other.py").write_text("# no kernels here")
    assert outer_of_one() == [11, 1]


def test_an_entry_of_an_older_release_that_cannot_be_read_is_made_anew(package):
    folder, outer_of_one = package
    outer_of_one()
    indexes = list((folder / "__pycache__").glob("*.nbi"))
    assert indexes
    for index in indexes:
        index.write_bytes(pickle.dumps(numba.__version__) + b"cno_such_module\nNoSuchClass\n.")
    assert outer_of_one() == [2, 0]
