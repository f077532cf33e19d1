"""The guest tool: what it runs, what it passes on, and when it gives up."""

import os
import shlex
import subprocess
import time

import pytest

from tools import vcan


def test_status_and_both_streams_are_passed_on(capfdbinary):
    status = vcan.run_guest(["sh", "-c", "printf out; printf err >&2; exit 7"], 30)
    assert status == 7
    assert capfdbinary.readouterr() == (b"out", b"err")


def test_timeout_ends_the_whole_group(tmp_path, capfd):
    mark = tmp_path / "late"
    start = time.monotonic()
    status = vcan.run_guest(["sh", "-c", f"(sleep 3; touch {mark}) & sleep 60"], 0.3)
    assert status == vcan.TIMED_OUT
    assert time.monotonic() - start < 2.5
    time.sleep(3)
    assert not mark.exists()


def test_script_carries_command_and_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("RTCOMP_WORD", "two words; and 'quotes'")
    monkeypatch.setenv("SECRET_OF_THE_HOST", "no")
    command = ["python", "-c", "print('a b')", "$HOME", "x y"]
    script = vcan.guest_script(command, tmp_path)
    assert shlex.split(script.splitlines()[-1]) == command
    assert "SECRET_OF_THE_HOST" not in script
    exports = "\n".join(line for line in script.splitlines() if line.startswith("export"))
    shown = subprocess.run(
        ["sh", "-c", f'{exports}\nprintf %s "$RTCOMP_WORD $NUMBA_CPU_NAME"'],
        check=True,
        capture_output=True,
        text=True,
    )
    assert shown.stdout == "two words; and 'quotes' generic"


def test_unpacked_kernel_is_used_as_it_is(tmp_path):
    image = tmp_path / "linux-image-test/boot/vmlinuz-1.2.3"
    image.parent.mkdir(parents=True)
    image.touch()
    assert vcan.kernel_image(tmp_path, "linux-image-test") == image


def test_kernel_that_is_not_to_be_had_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(vcan.GuestRefusedError, match="dpkg -x"):
        vcan.kernel_image(tmp_path, "linux-image-absent")


def test_failed_preparation_shows_its_output():
    with pytest.raises(vcan.GuestRefusedError, match="the reason"):
        vcan.run_quietly(["sh", "-c", "echo the reason; exit 3"])


def test_missing_programs_name_the_command_that_mends_it(tmp_path, monkeypatch):
    monkeypatch.setattr(vcan, "PACKAGES", {"no-such-program": "some-package"})
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(
        vcan.GuestRefusedError, match="apt-get install -y --no-install-recommends some-package"
    ):
        vcan.install_what_is_missing()


def test_host_that_has_vcan_needs_no_guest(monkeypatch):
    monkeypatch.setattr(vcan, "host_has_vcan", lambda: True)
    assert vcan.main(["--", "sh", "-c", "exit 5"]) == 5
