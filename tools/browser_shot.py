"""A picture of a page in Debian's headless Chromium with software GL, after some real seconds.

    python -m tools.browser_shot URL picture.png --seconds 20

`chromium --screenshot` takes its picture when the page has loaded, before the viewer has drawn anything; so Chromium
is driven over its debugging pipe (file descriptors 3 and 4, JSON ended by a zero byte).
"""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from rtcomp.errors import RequestError

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--hide-scrollbars",
    "--no-first-run",
    "--remote-debugging-pipe",
)


class Browser:
    """One Chromium with one page; `call` sends a command of the DevTools protocol and returns its result."""

    def __init__(self, profile: str, size: tuple[int, int]) -> None:
        program = shutil.which("chromium") or shutil.which("chromium-browser")
        if program is None:
            raise RequestError("no chromium here; apt-get install chromium")
        commands, self._write = os.pipe()
        self._read, answers = os.pipe()
        sized = f"--window-size={size[0]},{size[1]}"
        command = [
            "bash",  # sh may know descriptors of one digit only
            "-c",
            f'exec "$@" 3<&{commands} 4>&{answers}',
            "bash",
            program,
            *FLAGS,
            sized,
            f"--user-data-dir={profile}",
        ]
        self.process = subprocess.Popen(
            command, pass_fds=(commands, answers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(commands)
        os.close(answers)
        self._count, self._rest, self.session = 0, b"", ""
        self.messages: list[dict[str, Any]] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and wait for its result; events that come meanwhile go to `messages`."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                return answer["result"]
            self.messages.append(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            piece = os.read(self._read, 1 << 20)
            if not piece:
                raise RequestError("chromium ended before it answered")
            self._rest += piece
        text, self._rest = self._rest.split(b"\0", 1)
        return json.loads(text)

    def open(self, url: str) -> None:
        """Open a page."""
        target = self.call("Target.createTarget", url=url)["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Log"):
            self.call(f"{domain}.enable")

    def picture(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def requested(self) -> set[str]:
        """Hosts that the page has asked so far."""
        urls = [
            m["params"]["request"]["url"]
            for m in self.messages
            if m.get("method") == "Network.requestWillBeSent"
        ]
        return {url.split("/")[2] for url in urls if url.startswith(("http", "ws"))}

    def close(self) -> None:
        """End the browser."""
        self.process.kill()
        self.process.wait()
        os.close(self._write)
        os.close(self._read)


def shoot(url: str, path: Path, seconds: float, size: tuple[int, int]) -> set[str]:
    """Save a picture of the page after `seconds`; returns the hosts it asked."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(profile, size)
        try:
            browser.open(url)
            time.sleep(seconds)
            path.write_bytes(browser.picture())
            return browser.requested()
        finally:
            browser.close()


@click.command()
@click.argument("url")
@click.argument("picture", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--seconds", default=20.0, show_default=True, help="Real time before the picture.")
@click.option("--size", default=(1400, 800), show_default=True, type=(int, int), help="Width and height.")
def main(url: str, picture: Path, seconds: float, size: tuple[int, int]) -> None:
    """Save a PICTURE of the page at URL, and print the hosts it asked."""
    click.echo(" ".join(sorted(shoot(url, picture, seconds, size))))


if __name__ == "__main__":
    main()
