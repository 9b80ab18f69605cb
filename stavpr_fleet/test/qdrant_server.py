# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A stand-in of the Qdrant server: the part of its REST interface that the package's client uses.

The server is not on the package index. Requests are parsed as the interface describes them, and
served by the local mode of qdrant-client. Without quantization and approximate search.
"""

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
import threading
from typing import Any

from qdrant_client import models, QdrantClient


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), _Handler)
        self.points, self.lock = QdrantClient(':memory:'), threading.Lock()
        self.requests: list[str] = []


class _Handler(BaseHTTPRequestHandler):
    protocol_version = 'HTTP/1.1'
    server: _Server

    def log_message(self, *_: Any) -> None:
        pass

    def _serve(self) -> None:
        body = self.rfile.read(int(self.headers.get('Content-Length', 0)))
        path = self.path.partition('?')[0].strip('/').split('/')
        status, result = 200, None
        self.server.requests.append(f'{self.command} {self.path}')
        try:
            with self.server.lock:
                result = self._result(path, json.loads(body or 'null'))
        except KeyError as error:
            status, result = 404, f'not found: {error}'
        except Exception as error:
            status, result = 400, repr(error)
        state = 'ok' if status == 200 else {'error': result}
        content = json.dumps({'result': result, 'status': state, 'time': 0}).encode()
        self.send_response(status)
        self.send_header('Content-Type', 'application/json')
        self.send_header('Content-Length', str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    do_GET = do_PUT = do_POST = do_DELETE = _serve  # noqa: N815

    def _result(self, path: list[str], body: Any) -> Any:
        points, name, action = self.server.points, path[1], (self.command, *path[2:])
        if path[0] != 'collections':
            raise KeyError(self.path)
        if action == ('GET', 'exists'):
            return {'exists': points.collection_exists(name)}
        if action == ('PUT',):
            made = models.CreateCollection.model_validate(body)
            return points.create_collection(name, vectors_config=made.vectors)
        if not points.collection_exists(name):
            raise KeyError(name)
        if action == ('DELETE',):
            return points.delete_collection(name)
        if action == ('PUT', 'points'):
            points.upsert(name, models.PointsList.model_validate(body).points)
            return {'operation_id': 0, 'status': 'completed'}
        if action == ('POST', 'points'):
            result = points.retrieve(name, body['ids'], with_payload=True)
            return [json.loads(one.model_dump_json()) for one in result]
        if action == ('POST', 'points', 'query', 'batch'):
            requests = models.QueryRequestBatch.model_validate(body).searches
            answers = points.query_batch_points(name, requests)
            return [json.loads(one.model_dump_json()) for one in answers]
        raise KeyError(self.path)


class QdrantServer:
    """The stand-in on a free port, on a thread of this process."""

    def __init__(self) -> None:
        self._server = _Server()
        self.port: int = self._server.server_address[1]
        self.requests = self._server.requests
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def address(self, collection: str) -> str:
        """Return the address of a map."""
        return f'qdrant://127.0.0.1:{self.port}/{collection}'

    def close(self) -> None:
        """Stop; connections are refused afterwards."""
        self._server.shutdown()
        self._server.server_close()
