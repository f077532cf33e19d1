"""Run a command where there is SocketCAN: `python -m tools.vcan -- COMMAND …`.

On a host with SocketCAN the command runs as it is, with vcan0 up. Elsewhere it runs in a guest: a stock Debian
kernel with vcan loaded, in QEMU through virtme-ng, over the host's own files. The checkout and the cache are
shared for writing, everything else the guest writes is forgotten. Output and exit status are the command's.
"""

import argparse
import os
import platform
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO

CHECKOUT = Path(__file__).resolve().parent.parent
PACKAGES = {  # program → Debian package
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "depmod": "kmod",
    "udevadm": "udev",
    "ip": "iproute2",
}
WAIT = ("-o", "DPkg::Lock::Timeout=300")  # another installation may be at work
KERNEL = "linux-image-amd64"
PROBE_S = 30  # a guest under KVM boots in a few seconds; one that hangs hangs for good
PASSED_ON = ("NUMBA_", "PYTEST_", "RTCOMP_", "PYTHONPATH", "HYPOTHESIS_")
TIMED_OUT = 124  # as timeout(1) has it
WARM_UP = (
    "python -m pytest -q -p no:cacheprovider tests/test_socketcan.py tests/test_replay.py tests/test_live.py "
    "tests/test_latency.py tests/test_gk.py tests/test_rls.py"
)
# The emulated processor's own clock, which the kernel would not trust by itself; to read the HPET takes 7 µs there.
EMULATED = ("--disable-kvm", "--append", "tsc=reliable clocksource=tsc")
VCAN_UP = """\
modprobe vcan 2>/dev/null
ip link show vcan0 >/dev/null 2>&1 || ip link add dev vcan0 type vcan || exit 69
ip link set vcan0 mtu 72 2>/dev/null
ip link set vcan0 up && ip link set lo up || exit 69
"""


class GuestRefusedError(Exception):
    """The guest cannot be had here; says what is missing and what to do."""


def say(text: str) -> None:
    """A line of ours on standard error: standard output is the command's."""
    print(f"tools.vcan: {text}", file=sys.stderr, flush=True)


def cache_folder() -> Path:
    """Where kernels and compiled code are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "rtcomp-vcan"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def host_has_vcan() -> bool:
    """Whether this machine itself has vcan0, or lets us make it."""
    if not hasattr(socket, "AF_CAN"):
        return False
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    state = Path("/sys/class/net/vcan0/flags")
    if state.exists() and int(state.read_text(), 16) & 1:
        return True
    return os.geteuid() == 0 and subprocess.run(["sh", "-c", VCAN_UP], check=False).returncode == 0


def search_path() -> str:
    """PATH with this Python's folder first, so that `python` and `vng` are ours, and the system folders."""
    folders = [str(Path(sys.executable).parent), *os.environ.get("PATH", "").split(":")]
    folders += ["/usr/local/sbin", "/usr/sbin", "/sbin", "/usr/bin", "/bin"]
    return ":".join(dict.fromkeys(filter(None, folders)))


def install_what_is_missing() -> None:
    """Install QEMU and its helpers with apt-get, virtme-ng with pip. Raises GuestRefusedError where we may not."""
    path = search_path()
    missing = [package for program, package in PACKAGES.items() if not shutil.which(program, path=path)]
    if missing:
        install = ["install", "-y", "--no-install-recommends", *missing]
        if not shutil.which("apt-get") or os.geteuid() != 0:
            raise GuestRefusedError(
                f"missing on this machine: {', '.join(missing)}; as root: {shlex.join(['apt-get', *install])}"
            )
        run_quietly(["apt-get", *WAIT, "update"])
        run_quietly(["apt-get", *WAIT, *install], {"DEBIAN_FRONTEND": "noninteractive"})
    if not shutil.which("vng", path=path):
        run_quietly([sys.executable, "-m", "pip", "install", "virtme-ng"])


def run_quietly(
    command: Sequence[str], environment: dict[str, str] | None = None, cwd: Path | None = None
) -> str:
    """Run a preparation step; its output is shown only where it fails, as GuestRefusedError."""
    say(shlex.join(command))
    done = subprocess.run(
        command, check=False, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env=os.environ | {"PATH": search_path()} | (environment or {}), cwd=cwd,
    )  # fmt: skip
    if done.returncode:
        raise GuestRefusedError(f"`{shlex.join(command)}` failed ({done.returncode}):\n{done.stdout[-2000:]}")
    return done.stdout


def kernel_image(folder: Path, package: str = KERNEL) -> Path:
    """The kernel image of an unpacked Debian package in the cache, fetched if there is none yet."""
    home = folder / package
    images = sorted(home.glob("boot/vmlinuz-*"))
    if images:
        return images[-1]
    if not shutil.which("apt-get") or not shutil.which("dpkg"):
        raise GuestRefusedError(f"a Debian kernel is needed: unpack {package} with `dpkg -x` into {home}")
    depends = run_quietly(["apt-cache", "depends", package])
    names = [word for word in depends.split() if word.startswith("linux-image-") and word != package]
    if not names:
        raise GuestRefusedError(f"the package index knows no {package}; run `apt-get update` as root")
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        work = Path(temporary)
        run_quietly(["apt-get", "download", names[0]], cwd=work)
        run_quietly(["dpkg", "-x", str(next(work.glob("*.deb"))), str(work / "unpacked")])
        version = next((work / "unpacked/boot").glob("vmlinuz-*")).name.removeprefix("vmlinuz-")
        run_quietly(["depmod", "-b", str(work / "unpacked"), version])
        os.replace(work / "unpacked", home)
    return next(home.glob("boot/vmlinuz-*"))


def compiled_code(cache: Path) -> dict[str, str]:
    """Variables that make compiled code valid in the guest and on the host, and keep it between runs."""
    return {"NUMBA_CACHE_DIR": str(cache / "numba"), "NUMBA_CPU_NAME": "generic"}


def warm_up(command: str, cache: Path) -> None:
    """Run something here that compiles what the guest will need: there it takes minutes instead of seconds."""
    environment = os.environ | compiled_code(cache) | {"PATH": search_path()}
    say(f"compiling ahead with `{command}`")
    done = subprocess.run(
        shlex.split(command), check=False, cwd=CHECKOUT, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    if done.returncode:
        say(f"that failed ({done.returncode}), so the guest compiles itself:\n{done.stdout[-1000:]}")


def guest_script(command: Sequence[str], cache: Path) -> str:
    """What the guest's shell runs: vcan0 up, then the command in the checkout."""
    environment = {name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)}
    environment |= {"PATH": search_path(), "HOME": str(Path.home()), "RTCOMP_GUEST": "1"} | compiled_code(
        cache
    )
    exports = "".join(f"export {name}={shlex.quote(value)}\n" for name, value in environment.items())
    return f"{exports}{VCAN_UP}cd {shlex.quote(str(CHECKOUT))} || exit 69\n{shlex.join(command)}\n"


def guest_command(kernel: Path, script: Path, cache: Path, kvm: bool, cpus: int, memory: str) -> list[str]:
    """The virtme-ng command line that runs a script in a guest."""
    return [
        "vng", *([] if kvm else EMULATED), "-r", str(kernel), "--cpus", str(cpus), "--memory", memory,
        "--force-9p", f"--rwdir={CHECKOUT}", f"--rwdir={cache}", "--", f"sh {shlex.quote(str(script))}",
    ]  # fmt: skip


def pump(source: IO[bytes], target: IO[bytes] | None) -> None:
    """Pass bytes on as they come, or drop them, until the other end closes."""
    with source:
        while block := os.read(source.fileno(), 1 << 16):
            if target is not None:
                target.write(block)
                target.flush()


def run_guest(command: Sequence[str], timeout_s: float, output: bool = True) -> int:
    """Run virtme-ng; its streams are pipes, since QEMU opens plain files anew and would overwrite them."""
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env=os.environ | {"PATH": search_path()}, cwd=CHECKOUT, start_new_session=True,
    )  # fmt: skip
    targets = (sys.stdout.buffer, sys.stderr.buffer) if output else (None, None)
    pumps = [
        threading.Thread(target=pump, args=ends, daemon=True)
        for ends in zip((process.stdout, process.stderr), targets, strict=True)
    ]
    for thread in pumps:
        thread.start()
    try:
        status = process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        status = TIMED_OUT
        if output:
            say(f"ended after {timeout_s:.0f} s")
    finally:  # Ctrl-C too ends the whole group, QEMU included
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    for thread in pumps:
        thread.join(5)
    return status


def kvm_works(kernel: Path, cache: Path, memory: str) -> bool:
    """Whether a guest boots under KVM here: a device that opens proves nothing, so one is tried, once."""
    if not os.access("/dev/kvm", os.R_OK | os.W_OK):
        return False
    verdict = cache / f"kvm-{platform.node()}-{platform.release()}"
    if not verdict.exists():
        say(f"trying KVM (at most {PROBE_S} s, remembered in {verdict})")
        script = cache / "probe.sh"
        script.write_text("exit 0\n")
        status = run_guest(guest_command(kernel, script, cache, True, 1, memory), PROBE_S, output=False)
        verdict.write_text("works" if status == 0 else "fails")
    return verdict.read_text() == "works"


def run_in_guest(command: Sequence[str], arguments: argparse.Namespace) -> int:
    """Prepare and run the guest; returns the command's exit status. Raises GuestRefusedError."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise GuestRefusedError(
            f"the guest is for x86-64 Linux, this is {platform.system()} {platform.machine()}"
        )
    cache = cache_folder()
    install_what_is_missing()
    kernel = kernel_image(cache, arguments.kernel)
    for line in arguments.warm_up:
        warm_up(line, cache)
    kvm = arguments.kvm != "never" and kvm_works(kernel, cache, arguments.memory)
    with tempfile.NamedTemporaryFile("w", suffix=".sh", dir=cache) as script:
        script.write(guest_script(command, cache))
        script.flush()
        say(f"guest with {kernel.name}, {'KVM' if kvm else 'emulated: start and everything in it are slow'}")
        line = guest_command(kernel, Path(script.name), cache, kvm, arguments.cpus, arguments.memory)
        return run_guest(line, arguments.timeout)


def main(words: Sequence[str] | None = None) -> int:
    """Exit status: the command's; 2 where it could not be run at all; 124 after the timeout."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.vcan", description="Run a command where there is SocketCAN."
    )
    parser.add_argument("--guest", action="store_true", help="use the guest even where there is SocketCAN")
    parser.add_argument("--kernel", default=KERNEL, help="Debian package, e.g. linux-image-rt-amd64")
    parser.add_argument("--kvm", choices=["auto", "never"], default="auto")
    parser.add_argument("--cpus", type=int, default=2)
    parser.add_argument("--memory", default="3G")
    parser.add_argument("--timeout", type=float, default=3600, help="seconds")
    parser.add_argument(
        "--warm-up", action="append", help=f"run here first, to compile ahead; none: '' (default: {WARM_UP})"
    )
    parser.add_argument("command", nargs="+", help="after --")
    arguments = parser.parse_args(words)
    arguments.warm_up = [WARM_UP] if arguments.warm_up is None else list(filter(None, arguments.warm_up))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that the guest ends with us
    try:
        if not arguments.guest and host_has_vcan():
            return subprocess.run(arguments.command, check=False, cwd=CHECKOUT).returncode
        return run_in_guest(arguments.command, arguments)
    except GuestRefusedError as reason:
        say(str(reason))
        return 2


if __name__ == "__main__":
    sys.exit(main())
