# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a map, and its recorded places that are in none of them."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import os

import numpy as np
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import GrowingMap, Map, Session
from stavpr_ros.mapping.journal import Base, JournalPlace
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.output_file import FileVersion, Force

OpenJournal = Callable[[Base, Map], JournalWriter | None]


@dataclass(eq=False)
class SaveState:
    """
    The files of a map, and the number of its recorded places that are in none.

    :param path: file that the map was loaded from or last saved to, '' = none.
    :param base: its places, which recorded ones continue.
    :param open_journal: returns the journal of recorded places; None if it cannot be written.
    :param recorded: places recorded since the map was loaded or started; ``saved`` of them are in
        a file, the others in the ``journal`` if there is one.
    """

    path: str = ''
    base: Base = field(default_factory=Base)
    open_journal: OpenJournal = lambda base, template: None
    recorded: int = 0
    saved: int = 0
    journal: JournalWriter | None = None
    _files: dict[str, FileVersion | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path:
            self.own(self.path)

    @property
    def unsaved(self) -> int:
        """Return the number of recorded places that are in no file."""
        return self.recorded - self.saved

    def own(self, path: str) -> None:
        """Remember a file that contains this map now."""
        self._files[os.path.abspath(path)] = FileVersion.of(path)

    def own_version(self, path: str) -> Force:
        """Return the version of a file that contains this map, or did, and may be replaced."""
        return self._files.get(os.path.abspath(path)) or False

    def record(self, places: GrowingMap, features: LocalFeatures) -> None:
        """
        Count the newest place, and add it to the journal, which the first unsaved one opens.

        :param features: of its image.
        """
        newest = places.place(places.first + len(places) - 1)
        if self.journal is None and self.recorded == self.saved:
            stamps, ids = np.array([newest.stamp]), (newest.identifier,)
            template = Map(features, places.projection, stamps, ids, camera=places.camera)
            if newest.session:
                session = (Session(newest.session),)
                index = np.zeros(1, np.int32)
                template = replace(template, sessions=session, session_index=index)
            self.journal = self.open_journal(self.base, template)
        if self.journal is not None:
            thumbnail = places.thumbnails[-1]
            self.journal.append(JournalPlace(self.recorded, newest, features, thumbnail))
            self.journal.forget(places.first)  # of a route, which counts as recorded does
        self.recorded += 1

    def close_journal(self, delete: bool) -> None:
        """Close the journal, and delete it when nothing in it is needed."""
        if self.journal is not None:
            self.journal.close(delete or not self.unsaved)
            self.journal = None


@dataclass(frozen=True)
class MapSnapshot:
    """A map to be written, and its state when it was copied."""

    places: Map
    state: SaveState
    recorded: int

    def mark_saved(self, path: str) -> None:
        """Update the state after writing; later places, or another map in use, are unaffected."""
        state = self.state
        state.path = path
        state.own(path)
        if self.recorded < state.saved:  # a later state is in another file
            return
        state.saved, state.base = self.recorded, Base.of(path, self.places.stamps)
        if state.journal is not None and state.unsaved:
            state.journal.forget(self.recorded, state.base)
        else:
            state.close_journal(delete=True)
