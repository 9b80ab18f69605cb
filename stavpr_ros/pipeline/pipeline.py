# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pipeline: the operation, its places and their files, and the changes between them."""

from dataclasses import dataclass
import os
from pathlib import Path

from stavpr_ros.errors import InputError, MapFileError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.same_places import with_repeats
from stavpr_ros.mapping import GrowingMap, load_map, Map, merge_maps, open_map
from stavpr_ros.mapping.journal import Base
from stavpr_ros.mapping.stored_features import StoredFeatures
from stavpr_ros.mapping.stores import is_address, store_of
from stavpr_ros.pipeline.drives import write_drives
from stavpr_ros.pipeline.operations import CLASSES, LocalizationOperation, Operation
from stavpr_ros.pipeline.save_state import MapSnapshot, OpenJournal, SaveState
from stavpr_ros.pipeline.settings import PipelineSettings


@dataclass(frozen=True)
class LoadedMap:
    """A map, its file, and the extractor of its features."""

    path: str
    places: Map
    extractor: FeatureExtractor


def read_map(path: str, settings: PipelineSettings) -> LoadedMap:
    """
    Read a map, on any thread; its features stay in the file until an operation takes them.

    :param path: of a file, or the address of a fleet's map; of a folder, its maps become one, in
        memory, whose sessions have the names of the files.
    :raises StavprError: an invalid file, or a missing model.
    """
    if os.path.isdir(path):
        place_map = _join_maps(Path(path))
    else:
        place_map = store_of(path).open_map(path) if is_address(path) else open_map(path)
    extractor = place_map.extractor(settings.extraction_device, settings.model_path)
    return LoadedMap(path, place_map, extractor)


def _join_maps(folder: Path) -> Map:
    """Return the maps of a folder as one."""
    files = sorted(folder.glob('*.stavpr'))
    if not files:
        raise MapFileError(
            f'{folder} is a folder without maps: build a map of its images, build_map'
        )
    place_maps = [load_map(file) for file in files]
    for file, place_map in zip(files, place_maps, strict=True):
        if place_map.settings != place_maps[0].settings:
            raise MapFileError(
                f'{file} has other settings of the features than {files[0]}: move one of them '
                'elsewhere, or build it again'
            )
    return merge_maps(place_maps, [file.stem for file in files])


class Pipeline:
    """
    Runner of one operation. Properties aside, all calls must come from one thread.

    :param operation: name of the first one, of ``OPERATIONS``.
    :param open_journal: of recorded places; None = they are in memory only.
    :raises StavprError: invalid settings, or a missing model.

    ``operation`` and ``settings`` are those in force; :meth:`change` sets them. Images are for
    ``operation.process``.
    """

    def __init__(
        self,
        settings: PipelineSettings,
        operation: str = 'localization',
        open_journal: OpenJournal = lambda base, template: None,
    ) -> None:
        self.settings, self._open_journal = settings, open_journal
        # the map of localization, whose kind of features loop closure takes, and its files
        self._map: Map | None = None
        self._map_save_state = SaveState(open_journal=open_journal)
        self.operation: Operation = LocalizationOperation(
            settings, None, None, self._map_save_state
        )
        settings.require_operation(operation)
        self._start(operation, settings, None)

    @property
    def places(self) -> Map | GrowingMap | None:
        """Return the map, or the recorded route."""
        return self.operation.places

    @property
    def save_state(self) -> SaveState:
        """Return the files of the places in use."""
        return self.operation.save_state

    @property
    def unsaved(self) -> int:
        """Return the number of places in use that are in no file."""
        return min(self.save_state.unsaved, len(self.places or ()))

    @property
    def problem(self) -> str:
        """Return why places, or the file, of the map cannot be reached; empty while they can."""
        place_map, recognizer = self._map, self.operation.recognizer
        problem = recognizer.problem if recognizer else ''
        if place_map is not None and isinstance(place_map.features, StoredFeatures):
            problem = problem or place_map.features.file.problem
        return problem

    def change(
        self,
        settings: PipelineSettings | None = None,
        operation: str | None = None,
        loaded: LoadedMap | None = None,
    ) -> None:
        """
        Change settings, operation and map, all or nothing; None keeps the current one.

        A route that was recorded becomes the map of the next operation. Settings alone cannot fail
        when they differ in threshold, min_probability, max_error, keyframes, candidates and
        geometric check only.

        :param settings: other settings than these take effect with the next operation or map.
        :param loaded: the map to localize on, to extend, or (loop closure) whose kind of features
            to use.
        :raises InputError: unsaved places would be lost.
        :raises OutputError: a recorded drive, which may update the map, cannot be written.
        :raises StavprError: an unknown operation, or invalid settings.
        """
        settings, name = settings or self.settings, operation or self.operation.name
        settings.require_operation(name)
        if loaded is not None or name != self.operation.name:
            self._require_no_loss(name, loaded)
            if settings.update_map:
                write_drives(self.operation, lambda function: function())
            self._start(name, settings, loaded)
        else:
            self.operation.apply(settings)
        self.settings = settings

    def snapshot(self) -> MapSnapshot:
        """
        Return the map, or the recorded route, to be written to a file.

        :raises InputError: there are no places.
        """
        place_map, state = self._places_as_map()
        if place_map is None:
            reason = self.operation.missing or 'no places'
            raise InputError(f'there is nothing to save yet: {reason}')
        if place_map.partial:
            raise InputError(f'the map of a fleet stays where it is: {state.path}')
        return MapSnapshot(place_map, state, state.recorded)

    def close_journals(self, delete_route: bool) -> list[str]:
        """
        Close the journals at the end; return those with unsaved places.

        :param delete_route: a route of loop closure is needed no longer.
        """
        paths = []
        for state in {self.save_state, self._map_save_state}:
            is_route = self.operation.name == 'loop_closure' and state is self.save_state
            path = str(state.journal.path) if state.journal and state.unsaved else ''
            state.close_journal(delete=delete_route and is_route)
            if path and not (delete_route and is_route):
                paths.append(path)
        return paths

    def _start(self, name: str, settings: PipelineSettings, loaded: LoadedMap | None) -> None:
        """Start an operation; an error changes nothing."""
        place_map, state = self._places_as_map()
        extractor = self.operation.extractor
        if loaded is not None:
            place_map, extractor = loaded.places, loaded.extractor
            base = Base.of(loaded.path, loaded.places.stamps)
            state = SaveState(loaded.path, base, open_journal=self._open_journal)
        elif name == 'localization' and state.recorded and place_map is not None:
            place_map = with_repeats(place_map)
        is_route, before = name == 'loop_closure', {self.save_state, self._map_save_state}
        new_state = SaveState(open_journal=self._open_journal) if is_route else state
        self.operation = CLASSES[name](settings, place_map, extractor, new_state)
        # in mapping, it is part of the growing map
        self._map, self._map_save_state = None if name == 'mapping' else place_map, state
        for old_state in before - {new_state, state}:
            old_state.close_journal(
                delete=False
            )  # its places were discarded, but may be recovered

    def _require_no_loss(self, name: str, loaded: LoadedMap | None) -> None:
        """Reject the loss of unsaved places; loading a map in localization discards them."""
        present = self.operation.name
        leaves = name == 'loop_closure' != present  # its route replaces the recorded map
        replaces = loaded is not None and present == 'mapping'
        if self.unsaved and (leaves or replaces):
            raise InputError(
                f'the map has {self.unsaved} places that are not saved: save_map first (or '
                'discard them by load_map, in operation localization)'
            )
        is_route = present == name == 'loop_closure'
        if loaded is not None and is_route and len(self.places or ()):
            raise InputError(
                'the recorded route would be lost: save_map, then set_operation localization'
            )

    def _places_as_map(self) -> tuple[Map | None, SaveState]:
        """Return a copy of the recorded places, or the map, and its files; None without any."""
        places = self.places
        if places is None or not len(places):
            return self._map, self._map_save_state
        place_map = places.snapshot() if isinstance(places, GrowingMap) else places
        return place_map, self.save_state
