# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loading of the node's map from a file, while the old one stays in use."""

from collections.abc import Callable
from concurrent.futures import wait
from contextlib import AbstractContextManager, nullcontext
import threading
import time

from stavpr_ros.errors import MapFileError, StavprError
from stavpr_ros.mapping import GrowingMap, Map, verify_map
from stavpr_ros.pipeline import LoadedMap
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.worker import END_POLL
from stavpr_ros.threads import call_on_thread

LOAD_TIMEOUT = 120.0  # seconds to read a map
REST = 20.0  # pauses of the thread that compares hashes, as multiples of its computing time
MAX_REST = 1.0  # seconds; a thread that waits for a processor seems to compute long


class MapLoader:
    """
    Loads maps, one at a time.

    :param node: it logs, and stops waiting for a file when it ends.
    :param read: returns the map of a file; called on a thread of its own.
    :param use: takes a map into use.
    :param in_use: returns the places in use.
    :param on_change: called when ``path`` or ``problem`` has changed.

    ``path`` is the path of the map that is being loaded, '' = none; ``problem`` the error of the
    last map, for the diagnostics.
    """

    def __init__(
        self,
        node: ManagedNode,
        read: Callable[[str], LoadedMap],
        use: Callable[[LoadedMap], None],
        in_use: Callable[[], Map | GrowingMap | None],
        on_change: Callable[[], None],
    ) -> None:
        self._node, self._read, self._use, self._in_use = node, read, use, in_use
        self._on_change = on_change
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._verifying = threading.Thread()  # the latest one
        self.path = self.problem = ''

    def load(
        self, path: str, lock: AbstractContextManager[object] | None = None, verify: bool = False
    ) -> None:
        """
        Load a map and use it; meanwhile, and after an error, the old one stays in use.

        :param lock: acquired to put the map into use, not to read its file.
        :param verify: compare its hashes first; otherwise a thread does so while it is in use.
        :raises StavprError: an invalid file, model or setting, or a file that takes too long.
        """
        with self._lock:
            self.path, self.problem = path, ''
            self._on_change()
            try:
                loaded = self._read_in_time(path, verify)
                with lock or nullcontext():
                    self._use(loaded)
            except Exception as error:
                self.problem = f'cannot load {path}: {error}'
                raise
            finally:
                self.path = ''
                self._on_change()
        places = loaded.places
        self._node.get_logger().info(
            f'map {path}: {len(places)} places, features {places.settings.kind}, '
            f'{places.settings.strips} strips of {places.dimension} dimensions'
        )
        # reads all of the file, for seconds: the map is in use meanwhile
        if not (places.partial or verify):
            self._verifying = threading.Thread(
                target=self._verify, args=(path, places), daemon=True
            )
            self._verifying.start()

    def stop(self) -> None:
        """End the comparison of hashes, which keeps the map in memory."""
        self._ended.set()
        if self._verifying.is_alive():
            self._verifying.join(END_POLL)

    def _read_in_time(self, path: str, verify: bool) -> LoadedMap:
        """Read a map on a thread that is abandoned when it takes too long, or the node ends."""

        def read() -> LoadedMap:
            loaded = self._read(path)
            if verify:
                verify_map(loaded.places)
            return loaded

        reading = call_on_thread(read, 'reading')
        end = time.monotonic() + LOAD_TIMEOUT
        while not wait([reading], END_POLL).done:
            if self._node.ending.is_set():
                raise StavprError('the node ends')
            if time.monotonic() > end:
                raise StavprError(
                    f'{path} was not read within {LOAD_TIMEOUT:g} s: copy it to a faster disk'
                )
        return reading.result()

    def _verify(self, path: str, places: Map) -> None:
        """Compare the file of the map in use with its hashes; log damage, and keep it."""

        def rest(seconds: float) -> None:
            if self._ended.wait(min(REST * seconds, MAX_REST)) or self._in_use() is not places:
                raise MapFileError(f'map {path} is not in use any more')

        try:
            verify_map(places, rest)
            self._node.get_logger().info(f'map {path} is verified')
        except MapFileError as error:
            if self._in_use() is places and not self._ended.is_set():
                self.problem = f'the map in use is not reliable: {error}'
                self._node.get_logger().error(self.problem)
                self._on_change()
