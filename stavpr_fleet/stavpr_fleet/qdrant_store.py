# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A map in Qdrant: on a server that many robots query, or in a folder, embedded (Qdrant Edge).

A point is a place: its id the index of the place, its payload stamp, identifier, pose, session and
the strips as float16. One more point, ``INDEX_POINT``, has the index of the map.
It is written last: without it, an upload was interrupted.
"""

import base64
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np
from stavpr_fleet.store import MapIndex, place_vectors
from stavpr_ros.errors import (
    FleetError,
    OutputTakenError,
    SettingsError,
    StavprError,
    UnavailableError,
    UnfitMapError,
)
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import load_map, Map, save_map, select_places, Session

INDEX_POINT = 2**40
TIMEOUT = 5  # seconds that the server may take for a response
LOOPBACK = {'localhost', '127.0.0.1', '::1'}  # hosts to which a key is sent without TLS
AT_ONCE = 256  # places of a request of the upload
VERSION = 1

Point = tuple[int, list[float], dict[str, Any]]  # id, vector, payload


class Points(Protocol):
    """A collection of points, of the server or embedded."""

    def create(self, dimension: int, force: bool) -> None:
        """Create the collection, empty; OutputTakenError if there is one, and not force."""

    def upsert(self, points: list[Point]) -> None:
        """Write points."""

    def nearest(self, vectors: np.ndarray, count: int) -> list[list[int]]:
        """Return the ids of the points nearest to each vector, nearest first."""

    def payloads(self, ids: list[int]) -> dict[int, dict[str, Any]]:
        """Return the payloads of those points that exist."""


class ServerPoints:
    """
    Points of a Qdrant server, by its REST interface.

    :param url: address of the server; its API key is taken from the variable ``QDRANT_API_KEY``.
    :param collection: name.
    """

    def __init__(self, url: str, collection: str) -> None:
        try:
            from qdrant_client import models, QdrantClient
        except ImportError as error:
            raise UnavailableError(
                f'a map on a Qdrant server requires the package qdrant-client ({error}): pip '
                'install qdrant-client'
            ) from error
        self._models, self._name, self._url = models, collection, url
        key = os.environ.get('QDRANT_API_KEY')
        if key and url.startswith('http:') and urlsplit(url).hostname not in LOOPBACK:
            raise SettingsError(
                f'{url}: QDRANT_API_KEY would be sent without encryption: take qdrant+https://, '
                'or unset it'
            )
        self._client = QdrantClient(
            url=url, api_key=key, timeout=TIMEOUT, check_compatibility=False
        )

    def _call(self, method: str, **arguments: Any) -> Any:
        try:
            return getattr(self._client, method)(collection_name=self._name, **arguments)
        except Exception as error:  # of the client, of its connection, or of a damaged response
            reason = str(error).strip().partition('\n')[0] or type(error).__name__
            raise FleetError(
                f'the Qdrant server {self._url}, collection {self._name!r}: {reason}'
            ) from error

    def create(self, dimension: int, force: bool) -> None:
        """See :class:`Points`."""
        models = self._models
        if self._call('collection_exists'):
            if not force:
                raise OutputTakenError(
                    f'collection {self._name!r} exists on {self._url}: give --force to replace it'
                )
            self._call('delete_collection')
        self._call(
            'create_collection',
            vectors_config=models.VectorParams(
                size=dimension, distance=models.Distance.DOT, on_disk=True
            ),
            quantization_config=models.ScalarQuantization(
                scalar=models.ScalarQuantizationConfig(
                    type=models.ScalarType.INT8, always_ram=True
                )
            ),
            on_disk_payload=True,
        )

    def upsert(self, points: list[Point]) -> None:
        """See :class:`Points`."""
        records = [
            self._models.PointStruct(id=number, vector=vector, payload=payload)
            for number, vector, payload in points
        ]
        self._call('upsert', points=records, wait=True)

    def nearest(self, vectors: np.ndarray, count: int) -> list[list[int]]:
        """See :class:`Points`."""
        requests = [
            self._models.QueryRequest(query=vector.tolist(), limit=count) for vector in vectors
        ]
        responses = self._call('query_batch_points', requests=requests)
        return [[point.id for point in one.points] for one in responses]

    def payloads(self, ids: list[int]) -> dict[int, dict[str, Any]]:
        """See :class:`Points`."""
        records = self._call('retrieve', ids=ids, with_payload=True)
        return {point.id: point.payload for point in records}


class EdgePoints:
    """
    Points in a folder, embedded in this process (Qdrant Edge).

    :param folder: one process at a time opens it.
    """

    def __init__(self, folder: str) -> None:
        try:
            import qdrant_edge
        except ImportError as error:
            raise UnavailableError(
                f'a map in a folder of Qdrant requires the package qdrant-edge-py ({error}): pip '
                'install qdrant-edge-py'
            ) from error
        self._edge, self._folder = qdrant_edge, Path(folder)
        self._shard: Any = None

    def _open(self) -> Any:
        if self._shard is None:
            if not (self._folder / 'edge_config.json').is_file():
                raise FleetError(
                    f'no map of Qdrant in {self._folder}: write it with `map upload MAP '
                    f'qdrant:{self._folder}`'
                )
            self._shard = self._call(self._edge.EdgeShard.load, str(self._folder))
        return self._shard

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:  # the package has no error type of its own
            raise FleetError(f'the folder {self._folder} of Qdrant Edge: {error}') from error

    def create(self, dimension: int, force: bool) -> None:
        """See :class:`Points`."""
        if self._folder.exists() and any(self._folder.iterdir()):
            # only what was written here is ever deleted
            if not force or not (self._folder / 'edge_config.json').is_file():
                raise OutputTakenError(
                    f'{self._folder} is not empty: give another folder'
                    + ('' if force else ', or --force to replace a map of Qdrant')
                )
            shutil.rmtree(self._folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        edge = self._edge
        vectors = edge.EdgeVectorParams(size=dimension, distance=edge.Distance.Dot)
        self._shard = edge.EdgeShard.create(str(self._folder), edge.EdgeConfig(vectors=vectors))

    def upsert(self, points: list[Point]) -> None:
        """See :class:`Points`."""
        records = [self._edge.Point(*point) for point in points]
        self._call(self._shard.update, self._edge.UpdateOperation.upsert_points(records))
        self._call(self._shard.flush)

    def nearest(self, vectors: np.ndarray, count: int) -> list[list[int]]:
        """See :class:`Points`."""
        edge = self._edge
        requests = [
            edge.QueryRequest(limit=count, query=edge.Query.Nearest(vector.tolist()))
            for vector in vectors
        ]
        responses = self._call(self._open().query_batch, edge.QueryBatchRequest(requests))
        return [[point.id for point in one] for one in responses]

    def payloads(self, ids: list[int]) -> dict[int, dict[str, Any]]:
        """See :class:`Points`."""
        records = self._call(self._open().retrieve, ids, True, False)
        return {point.id: point.payload for point in records}


class QdrantStore:
    """
    A map whose places are points; see :class:`stavpr_fleet.store.PlaceStore`.

    :raises FleetError: unreachable, or no complete map.
    """

    def __init__(self, points: Points) -> None:
        self._points = points
        payload = points.payloads([INDEX_POINT]).get(INDEX_POINT)
        if payload is None:
            raise FleetError('no map, or one whose upload was interrupted: upload again')
        with _foreign():
            self.index = _read_index(payload)

    def nearest(self, vectors: np.ndarray, count: int) -> np.ndarray:
        """See :class:`stavpr_fleet.store.PlaceStore`."""
        rows = self._points.nearest(vectors, count + 1)  # the point of the index may be found
        out = np.full((len(vectors), count), -1, np.int64)
        for row, ids in zip(out, rows, strict=True):
            places = [i for i in ids if 0 <= i < self.index.places][:count]
            row[: len(places)] = places
        return out

    def fetch(self, places: np.ndarray) -> tuple[Map, np.ndarray]:
        """See :class:`stavpr_fleet.store.PlaceStore`."""
        payloads = self._points.payloads(places.tolist())
        if missing := set(places.tolist()) - payloads.keys():
            raise FleetError(f'{len(missing)} places are missing, such as {min(missing)}')
        with _foreign():
            return _read_places([payloads[place] for place in places.tolist()], self.index)


def upload_to_qdrant(place_map: Map, points: Points, force: bool = False) -> None:
    """
    Write a map into an empty collection.

    :raises OutputTakenError: the collection is there, and not force.
    :raises FleetError: it cannot be written.
    """
    index = MapIndex.of(place_map)
    points.create(index.dimension, force)
    centering = index.centering()
    for low in range(0, index.places, AT_ONCE):
        places = np.arange(low, min(low + AT_ONCE, index.places))
        part = select_places(place_map, places)
        vectors = place_vectors(centering.places(part.features).strips)
        payloads = _written_places(place_map, part, places)
        points.upsert(list(zip(places.tolist(), vectors.tolist(), payloads, strict=True)))
    points.upsert([(INDEX_POINT, [0.0] * index.dimension, _written_index(index))])


def _written_index(index: MapIndex) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        save_map(index.sample, f'{folder}/sample')
        sample = Path(folder, 'sample').read_bytes()
    return {
        'version': VERSION,
        'places': index.places,
        'firsts': index.firsts.tolist(),
        'sessions': [_written_session(session) for session in index.sessions],
        'map_id': index.map_id,
        'sample': base64.b64encode(sample).decode(),
    }


def _written_session(session: Session) -> dict[str, Any]:
    """Return what is known of a session but its intrinsics; release 0.9 knows no camera."""
    values = asdict(replace(session, intrinsics=None))
    return {key: value for key, value in values.items() if value not in ('', None)}


def _read_index(payload: dict[str, Any]) -> MapIndex:
    if payload['version'] != VERSION:
        raise FleetError(f'a map of version {payload["version"]}: expected {VERSION}; update')
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, 'sample')
        file.write_bytes(base64.b64decode(payload['sample']))
        sample = load_map(file)
    return MapIndex(
        int(payload['places']),
        np.array(payload['firsts'], np.int64),
        tuple(Session(**session) for session in payload['sessions']),
        sample,
        str(payload['map_id']),
    )


def _written_places(place_map: Map, part: Map, places: np.ndarray) -> Iterator[dict[str, Any]]:
    strips = part.features.strips.astype(np.float16)
    for i, place in enumerate(places.tolist()):
        pose, session = place_map.pose(place), place_map.session(place)
        yield {
            'index': place,
            'session': '' if session is None else session.id,
            'stamp': int(part.stamps[i]),
            'id': part.ids[i],
            'pose': None if pose is None else pose.tolist(),
            'same_as': place if place_map.same_as is None else int(place_map.same_as[place]),
            'strips': base64.b64encode(strips[:, i].tobytes()).decode(),
            'weights': part.features.weights[:, i].tolist(),
        }


def _read_places(payloads: list[dict[str, Any]], index: MapIndex) -> tuple[Map, np.ndarray]:
    W, d = index.sample.settings.strips, index.sample.dimension
    parts = [np.frombuffer(base64.b64decode(one['strips']), '<f2') for one in payloads]
    strips = np.stack(parts).reshape(-1, W, d).transpose(1, 0, 2).astype(np.float32)
    weights = np.array([one['weights'] for one in payloads], np.float32).T
    if not (np.isfinite(strips).all() and weights.shape == (W, len(payloads))):
        raise FleetError('features are not finite')
    none = [np.nan] * 7
    poses = [none if one['pose'] is None else one['pose'] for one in payloads]
    sample = index.sample
    place_map = replace(
        sample,
        features=LocalFeatures(
            np.ascontiguousarray(strips),
            np.ascontiguousarray(weights),
            sample.settings,
            sample.features.cells,
        ),
        stamps=np.array([one['stamp'] for one in payloads], np.int64),
        ids=tuple(str(one['id']) for one in payloads),
        poses=np.array(poses, np.float64).reshape(-1, 7),
        thumbnails=(),
        sessions=(),
        session_index=None,
        same_as=None,
        map_id='',
    )
    return place_map, np.array([one['same_as'] for one in payloads], np.int64)


@contextmanager
def _foreign() -> Iterator[None]:
    """Turn any error of reading foreign data into a FleetError."""
    try:
        yield
    except FleetError:
        raise
    except UnfitMapError as error:
        raise FleetError(str(error)) from error
    except Exception as error:
        text = str(error) if isinstance(error, StavprError) else repr(error)
        raise FleetError(f'its data is damaged, or of another program: {text}') from error


def server_points(address: str) -> ServerPoints:
    """
    Return the collection that an address names.

    :param address: ``HOST:PORT/COLLECTION`` behind ``qdrant://`` or ``qdrant+https://``.
    """
    scheme, _, rest = address.partition('://')
    host, _, name = rest.partition('/')
    if not host or not name or '/' in name:
        raise SettingsError(
            f'{address}: expected qdrant://HOST:PORT/COLLECTION, or qdrant+https://...'
        )
    return ServerPoints(f'{"https" if scheme.endswith("https") else "http"}://{host}', name)
