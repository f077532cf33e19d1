"""The web page: rerun's own web viewer, passed on with a rule that keeps the browser from talking to anybody else.

Left alone, the page asks hosts of its maker (usage telemetry, versions, fonts). A content security policy makes the
browser refuse that; the only other address it may reach is our own stream.
"""

import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEPT = ("Content-Type", "Content-Encoding", "Cache-Control")


def serve_page(bind: str, port: int, source: str, stream: str) -> Callable[[], None]:
    """Serve what `source` (http://host:port) serves on `bind`:`port`; returns what ends it.

    `stream` (http://host:port) is where the page may connect to.
    """
    policy = (
        "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
        f"style-src 'self' 'unsafe-inline'; worker-src 'self' blob:; connect-src 'self' data: blob: {stream}"
    )
    server = ThreadingHTTPServer((bind, port), _handler(source, policy))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="page", daemon=True).start()

    def end() -> None:
        server.shutdown()
        server.server_close()

    return end


def _handler(source: str, policy: str) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Passes GET on."""

        def do_GET(self) -> None:
            """Fetch from the source and add the policy."""
            path = self.path.split("?")[0]
            try:
                with urllib.request.urlopen(source + path, timeout=30.0) as answer:  # noqa: S310 - http, our own viewer
                    status, headers, body = answer.status, answer.headers, answer.read()
            except urllib.error.HTTPError as error:
                status, headers, body = error.code, error.headers, b""
            except OSError:
                status, headers, body = 502, {}, b"the viewer has ended"
            self.send_response(status)
            for name in KEPT:
                if (value := headers.get(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Security-Policy", policy)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    return Handler
