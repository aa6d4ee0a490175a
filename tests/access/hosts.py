"""A web server on this machine that imitates the hosts of data sets, and misbehaves if told to."""

import contextlib
import hashlib
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

from semantic2d_dataset.access.known_datasets import KnownDataset, ZenodoRecord


def make_bytes(size, seed=0):
    return (hashlib.sha256(str(seed).encode()).digest() * (size // 32 + 1))[:size]


def md5(body):
    return f"md5:{hashlib.md5(body).hexdigest()}"


class _Server(ThreadingHTTPServer):
    """Says nothing of clients that went away: some tests kill them."""

    def handle_error(self, request: object, client_address: object) -> None:
        pass


class Host:
    """Serves files as a record lists them.

    ``moods`` are taken one by one, each by a request for a file (those for lists are answered);
    ``list_moods`` by requests for the list. Each is called with the handler, the whole body and
    the offset asked for.
    """

    def __init__(self, files):
        self.files = dict(files)
        self.checksums = {name: md5(body) for name, body in files.items()}
        self.moods = []
        self.list_moods = []
        self.requests = []
        self.pages = {}
        self._server = _Server(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def close(self):
        self._server.shutdown()
        self._server.server_close()

    @property
    def offsets(self):
        """The offsets that files were asked from, in order."""
        return [offset for path, offset, _ in self.requests if "/files/" in path]

    def dataset(self, *mirrors, **more):
        return KnownDataset(
            "d", "1", "D", "unknown", (ZenodoRecord("7", self.url), *mirrors), **more
        )

    def record(self):
        base = f"{self.url}/api/records/7/files"
        return {
            "files": [
                {
                    "key": name,
                    "size": len(body),
                    "checksum": self.checksums[name],
                    "links": {"self": f"{base}/{name}/content"},
                }
                for name, body in self.files.items()
            ]
        }

    def _handler(self):
        host = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *_):
                pass

            def do_GET(self):
                with contextlib.suppress(ConnectionError):
                    host.answer(self)

        return Handler

    def answer(self, handler):
        said = handler.headers.get("Range", "bytes=0-")
        offset = int(said.removeprefix("bytes=").removesuffix("-"))
        self.requests.append((handler.path, offset, dict(handler.headers)))
        if "/files/" not in handler.path and "/resolve/" not in handler.path:
            body = self.pages.get(handler.path, self.record())
            mood = self.list_moods.pop(0) if self.list_moods else send
            mood(handler, body if isinstance(body, bytes) else json.dumps(body).encode(), 0)
            return
        name = unquote(handler.path.removesuffix("/content")).partition("/files/")[2]
        if "/resolve/" in handler.path:
            name = unquote(handler.path).partition("/dataset/")[2]
        if name not in self.files:
            status(404)(handler, b"", 0)
            return
        mood = self.moods.pop(0) if self.moods else send
        mood(handler, self.files[name], offset)


def start(handler, code, length=None, **headers):
    handler.send_response(code)
    if length is not None:
        handler.send_header("Content-Length", str(length))
    else:
        handler.close_connection = True
    for key, value in headers.items():
        handler.send_header(key.replace("_", "-"), value)
    handler.end_headers()


def send(handler, body, offset):
    """As it should be."""
    if offset:
        said = f"bytes {offset}-{len(body) - 1}/{len(body)}"
        start(handler, 206, len(body) - offset, Content_Range=said)
    else:
        start(handler, 200, len(body))
    handler.wfile.write(body[offset:])


def cut_after(count):
    def mood(handler, body, offset):
        send(handler, Short(body, offset + count), offset)
        handler.close_connection = True
        handler.connection.close()

    return mood


class Short(bytes):
    """Bytes that say that they are longer than what is sent of them."""

    def __new__(cls, body, end):
        made = super().__new__(cls, body)
        made.end = end
        return made

    def __getitem__(self, key):
        return bytes(self)[key.start : self.end]


def stall(handler, body, offset):
    start(handler, 200, len(body))
    handler.wfile.write(body[:100])
    time.sleep(1)
    handler.close_connection = True


def drip(handler, body, offset):
    """Slowly, 64 KiB at a time."""
    start(handler, 206, len(body) - offset, Content_Range=f"bytes {offset}-/{len(body)}")
    for k in range(offset, len(body), 1 << 16):
        handler.wfile.write(body[k : k + (1 << 16)])
        time.sleep(0.05)


def drip_slowly(handler, body, offset):
    """A hundred bytes at a time, for as long as a client bears it."""
    start(handler, 200, len(body))
    for k in range(0, len(body), 100):
        handler.wfile.write(body[k : k + 100])
        time.sleep(0.05)


def other_length(handler, body, offset):
    send(handler, body + b"more", 0)


def endless(handler, body, offset):
    start(handler, 200)
    handler.wfile.write(body * 3)


def whole(handler, body, offset):
    send(handler, body, 0)


def wrong_offset(handler, body, offset):
    said = f"bytes {offset - 1}-{len(body) - 1}/{len(body)}"
    start(handler, 206, len(body) - offset + 1, Content_Range=said)
    handler.wfile.write(body[offset - 1 :])


def web_page(handler, body, offset):
    start(handler, 200, len(body), Content_Type="text/html; charset=utf-8")
    handler.wfile.write(body)


def packed(handler, body, offset):
    start(handler, 200, len(body), Content_Encoding="gzip")
    handler.wfile.write(body)


def other_bytes(handler, body, offset):
    send(handler, bytes(len(body)), offset)


def redirect_to(url):
    def mood(handler, body, offset):
        start(handler, 302, 0, Location=url or handler.path)

    return mood


def status(code, **headers):
    def mood(handler, body, offset):
        start(handler, code, 0, **headers)

    return mood
