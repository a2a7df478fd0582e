"""A reader of server-sent events, as the specification has them."""

import contextlib
import http.client
import json
import queue
import socket
import threading
import urllib.parse
from dataclasses import dataclass

from daemon import DEADLINE_S


@dataclass
class Message:
    event: str
    data: dict
    id: str | None


class Stream:
    """Reads `/events` in a thread of its own."""

    def __init__(self, daemon, path: str = "/events", headers: dict[str, str] | None = None):
        address = urllib.parse.urlsplit(daemon.http)
        self._connection = http.client.HTTPConnection(address.hostname, address.port, timeout=DEADLINE_S)
        self._connection.request("GET", path, headers=headers or {})
        self._socket = self._connection.sock
        self.response = self._connection.getresponse()
        assert self.response.status == 200, self.response.read()
        assert self.response.headers["Content-Type"].startswith("text/event-stream")
        self._messages: queue.SimpleQueue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        event, data, number = "message", [], None
        with contextlib.suppress(OSError, http.client.HTTPException, AttributeError, ValueError):
            for line in self.response:
                name, _, value = line.decode().rstrip("\r\n").partition(":")
                value = value.removeprefix(" ")
                if name == "event":
                    event = value
                elif name == "data":
                    data.append(value)
                elif name == "id":
                    number = value
                elif not name and not value and data:
                    self._messages.put(Message(event, json.loads("\n".join(data)), number))
                    event, data, number = "message", [], None
        self._messages.put(None)

    def next(self, event: str, accept=lambda data: True) -> Message:
        """The next message of that name that `accept` likes; others are passed over."""
        while True:
            try:
                message = self._messages.get(timeout=DEADLINE_S)
            except queue.Empty:
                raise AssertionError(f"no `{event}` within {DEADLINE_S} s") from None
            assert message is not None, f"the stream ended before `{event}`"
            if message.event == event and accept(message.data):
                return message

    def ends(self) -> None:
        """Waits for the end."""
        while True:
            try:
                if self._messages.get(timeout=DEADLINE_S) is None:
                    return
            except queue.Empty:
                raise AssertionError(f"the stream did not end within {DEADLINE_S} s") from None

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(DEADLINE_S)
        self._connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
