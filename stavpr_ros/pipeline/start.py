# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of an operation: all that may fail or takes long, before the pipeline is changed."""

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from stavpr_ros.errors import MapFileError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, open_map, PlaceMap, verify_map
from stavpr_ros.mapping.stores import is_address, store_of
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.pipeline.view_bank import ViewBank
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.recognizer import SequenceRecognizer

BLANK_IMAGE = np.zeros((480, 640, 3), np.uint8)


@dataclass(frozen=True)
class LoadedMap:
    """A map, its file, and the extractor of its features."""

    path: str
    places: PlaceMap
    extractor: FeatureExtractor


@dataclass(frozen=True, eq=False)
class Operation:
    """
    The state of an operation.

    :param places: a fixed map in localization, otherwise a growing one.
    :param recognizer: of these places; None in mapping.
    :param views: of this recognizer and others; None without ``other_views``.
    """

    extractor: FeatureExtractor
    places: PlaceMap | GrowingMap
    recognizer: SequenceRecognizer | None = None
    views: ViewBank | None = None


@runtime_checkable
class PartialMap(Protocol):
    """A map in a store: it recognizes with the places that it has fetched."""

    def recognizer(self, settings: RecognizerSettings) -> SequenceRecognizer:
        """Return a recognizer of the map; SettingsError for settings that it does not have."""


def read_map(path: str, settings: PipelineSettings) -> LoadedMap:
    """
    Read a map, on any thread; its features stay in the file until an operation takes them.

    :param path: of a file, or the address of a fleet's map.
    :raises StavprError: an invalid file, or a missing model.
    """
    if os.path.isdir(path):
        maps = ', '.join(sorted(file.name for file in Path(path).glob('*.stavpr')))
        remedy = f'name one of its maps: {maps}' if maps else 'build a map of its images'
        raise MapFileError(f'{path} is a folder, not a map: {remedy} (build_map makes map files)')
    place_map = store_of(path).open_map(path) if is_address(path) else open_map(path)
    extractor = place_map.extractor(settings.extraction_device, settings.model_path)
    return LoadedMap(path, place_map, extractor)


def start_operation(
    name: str,
    settings: PipelineSettings,
    place_map: PlaceMap | None,
    extractor: FeatureExtractor | None,
) -> Operation | None:
    """
    Start an operation; None for localization without a map.

    :param place_map: the map to localize on, or to extend; loop closure starts a route of its own.
    :param extractor: of the map; None = of the settings, for growing maps.
    :raises StavprError: an unknown operation, invalid settings, or a missing model.
    """
    settings.require_operation(name)
    if name == 'localization':
        if place_map is None or extractor is None:
            return None
        recognizer = _recognizer(settings, place_map)
        _warm_up(recognizer, extractor, settings.sequence.length)
        views = None
        if settings.other_views and isinstance(recognizer, PlaceRecognizer):
            views = ViewBank(recognizer, place_map)
        return Operation(extractor, place_map, recognizer, views)
    extractor = extractor or settings.extractor()
    if name == 'mapping':
        extractor.extract([BLANK_IMAGE])
        if place_map is not None and place_map.partial:
            raise SettingsError(
                'operation mapping does not extend the map of a fleet: record a map of its own, '
                'without map_path'
            )
        if place_map is not None:
            verify_map(place_map)  # damage would be saved again, with correct hashes
        growing = (
            GrowingMap(extractor.settings, extractor.projection, settings.max_places)
            if place_map is None
            else GrowingMap.from_map(place_map, settings.max_places)
        )
        return Operation(extractor, growing)
    closer = _loop_closer(settings, settings.exclude_places, extractor)
    # a closer that excludes next to nothing needs few images to warm up
    _warm_up(_loop_closer(settings, 1, extractor), extractor, settings.sequence.length + 8)
    route = GrowingMap(
        extractor.settings,
        extractor.projection,
        settings.max_places,
        held_features=closer.features,
    )
    return Operation(extractor, route, closer)


def _recognizer(settings: PipelineSettings, place_map: PlaceMap) -> SequenceRecognizer:
    if not place_map.partial:
        backend = settings.matching_backend('localization')
        return PlaceRecognizer(place_map, settings.recognition(), backend, settings.precision)
    if settings.backend == 'cuda' or settings.precision != 'float32' or settings.other_views:
        raise SettingsError(
            f'backend {settings.backend}, precision {settings.precision}, other_views '
            f'{settings.other_views}: the map of a fleet is matched on the CPU in float32; take '
            'backend auto or cpu, precision float32, and other_views false'
        )
    assert isinstance(place_map, PartialMap)
    return place_map.recognizer(settings.recognition())


def _loop_closer(
    settings: PipelineSettings, exclude: int, extractor: FeatureExtractor
) -> LoopCloser:
    return LoopCloser(
        settings.recognition(),
        exclude,
        extractor.settings,
        limit=settings.max_places,
        exclude_seconds=settings.exclude_seconds,
        precision=settings.precision,
    )


def _warm_up(
    recognizer: SequenceRecognizer,
    extractor: FeatureExtractor,
    images: int,
) -> None:
    """Compile and allocate everything, so that the first image is as fast as the others."""
    features = extractor.extract([BLANK_IMAGE])
    for _ in range(images):
        recognizer.update(features)
    recognizer.ranked(2)
    recognizer.reset()
