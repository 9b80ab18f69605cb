# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The web server of the monitor: one page, server-sent events, the match image, commands."""

from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
import ipaddress
import json
import socket
from socketserver import TCPServer
import sys
import threading
import time
from typing import Any
from urllib.parse import urlsplit

from stavpr_lab.monitor.node import History
from stavpr_ros.errors import StavprError, UnavailableError

EVENT_SECONDS = 5.0  # most time between two events, so that a closed browser is noticed
MAX_REQUEST = 10_000  # bytes
PROTECTION = {
    'Cache-Control': 'no-store',
    'Content-Security-Policy': (
        "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        "img-src 'self' data:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
    ),
    'X-Content-Type-Options': 'nosniff',
    'X-Frame-Options': 'DENY',
}
NAMES = {'localhost', socket.gethostname().lower()}


class MonitorServer(ThreadingHTTPServer):
    """
    Serves the page; :meth:`start` runs it on a thread of its own.

    :param command: runs a command with a value and returns a message, or raises StavprError.
    :raises UnavailableError: the address cannot be used.
    """

    daemon_threads = True

    def __init__(
        self, host: str, port: int, history: History, command: Callable[[str, str], str]
    ) -> None:
        self.history, self.command = history, command
        self.page = (files('stavpr_lab.monitor') / 'page.html').read_bytes()
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise UnavailableError(
                f'{host}:{port} cannot be used: {error.strerror}; choose another --port or --host'
            ) from error
        self._thread = threading.Thread(target=self.serve_forever, name='server', daemon=True)

    @property
    def url(self) -> str:
        """Return the address of the page."""
        return f'http://{self.server_name}:{self.server_port}/'

    def server_bind(self) -> None:
        """Bind without the look-up of a host name, which may take seconds."""
        TCPServer.server_bind(self)
        host, self.server_port = self.server_address[:2]
        self.server_name = str(host)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the error of a request, unless the browser has just gone."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def start(self) -> None:
        """Serve from now on."""
        self._thread.start()

    def stop(self) -> None:
        """End the server, and all events."""
        self.history.close()
        self.shutdown()
        self._thread.join()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: MonitorServer
    protocol_version = 'HTTP/1.1'
    timeout = 30  # seconds for a silent client

    def do_GET(self) -> None:
        """Serve the page, the events or the image."""
        if not self._is_allowed():
            return
        path = self.path.partition('?')[0]
        if path == '/':
            self._send(HTTPStatus.OK, 'text/html; charset=utf-8', self.server.page)
        elif path == '/events':
            self._send_events()
        elif path == '/image.jpg' and self.server.history.image:
            self._send(HTTPStatus.OK, 'image/jpeg', self.server.history.image)
        else:
            self._send(HTTPStatus.NOT_FOUND, 'text/plain', b'not found')

    def do_POST(self) -> None:
        """Run a command, ``{"name": ..., "value": ...}``."""
        if not self._is_allowed():
            return
        # a foreign page can post a form or a text to a local address, but no JSON
        if self.headers.get_content_type() != 'application/json' or self.path != '/command':
            self._send(HTTPStatus.BAD_REQUEST, 'text/plain', b'expected JSON for /command')
            return
        try:
            size = int(self.headers.get('Content-Length', 0))
            if not 0 < size <= MAX_REQUEST:
                raise ValueError(f'{size} bytes')
            request = json.loads(self.rfile.read(size))
            name, value = str(request['name']), str(request.get('value', ''))
            (name + value).encode()  # JSON has lone surrogates, ROS has UTF-8
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            self.close_connection = True
            self._send(HTTPStatus.BAD_REQUEST, 'text/plain', f'no command: {error}'.encode())
            return
        try:
            result = {'success': True, 'message': self.server.command(name, value)}
        except StavprError as error:
            result = {'success': False, 'message': str(error)}
        self._send(HTTPStatus.OK, 'application/json', json.dumps(result).encode())

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log no requests."""

    def _is_allowed(self) -> bool:
        """Refuse pages of other sites, and foreign names of this host, which they may use."""
        host, origin = self.headers.get('Host', ''), self.headers.get('Origin')
        try:
            name = urlsplit(f'//{host}').hostname or ''
            allowed = name in NAMES or bool(ipaddress.ip_address(name))
        except ValueError:
            allowed = False
        if origin is not None and origin.partition('://')[2] != host:
            allowed, host = False, f'{host}, from {origin}'
        if not allowed:
            self.close_connection = True
            text = f'unknown host {host!r}: use the address of this machine'
            self._send(HTTPStatus.FORBIDDEN, 'text/plain', text.encode())
        return allowed

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header('Content-Type', kind)
        self.send_header('Content-Length', str(len(content)))
        for header, value in PROTECTION.items():
            self.send_header(header, value)
        self.end_headers()
        self.wfile.write(content)

    def _send_events(self) -> None:
        """Send changes until the browser or the server closes."""
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header('Content-Type', 'text/event-stream')
        self.send_header('Cache-Control', 'no-store')
        self.end_headers()
        history, version = self.server.history, 0
        try:
            with history.viewer():
                while not history.closed:
                    version, changes = history.since(version, EVENT_SECONDS)
                    changes['now'] = time.monotonic()  # as the times of samples and pose
                    self.wfile.write(f'data: {json.dumps(changes)}\n\n'.encode())
        except OSError:
            pass  # the browser has closed
