# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a map, and its recorded places that are in none of them."""

from dataclasses import dataclass, field
import os

from stavpr_ros.mapping import PlaceMap
from stavpr_ros.output_file import FileVersion, Force


@dataclass
class SaveState:
    """
    Files that hold a map, and the number of its recorded places that are in none.

    :param path: file that the map was loaded from or last saved to, '' = none.
    :param recorded: places recorded since the map was loaded or started; ``saved`` of them are in
        a file.
    """

    path: str = ''
    recorded: int = 0
    saved: int = 0
    _files: dict[str, FileVersion | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path:
            self.own(self.path)

    @property
    def unsaved(self) -> int:
        """Return the number of recorded places that are in no file."""
        return self.recorded - self.saved

    def own(self, path: str) -> None:
        """Remember a file that holds this map now."""
        self._files[os.path.abspath(path)] = FileVersion.of(path)

    def owned(self, path: str) -> Force:
        """Return the version of a file that holds, or held, this map and may be replaced."""
        return self._files.get(os.path.abspath(path)) or False


@dataclass(frozen=True)
class MapSnapshot:
    """A map to be written, and its state when it was copied."""

    places: PlaceMap
    state: SaveState
    recorded: int

    def mark_saved(self, path: str) -> None:
        """Update the state after writing; later places, or another map in use, are unaffected."""
        state = self.state
        state.path, state.saved = path, max(state.saved, self.recorded)
        state.own(path)
