"""How an operation begins: everything that may fail, and takes long, before anything is changed."""

from dataclasses import dataclass, replace

import numpy as np

from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, PlaceMap, open_map
from stavpr_ros.pipeline.operations import Localization, LoopClosure, Mapping, Observed, Operation
from stavpr_ros.pipeline.settings import OPERATIONS, PipelineSettings

BLANK = np.zeros((480, 640, 3), np.uint8)


@dataclass(frozen=True)
class LoadedMap:
    """A map that was read, and what describes images as its were."""

    path: str
    places: PlaceMap
    extractor: FeatureExtractor


def read_map(path: str, settings: PipelineSettings) -> LoadedMap:
    """
    Read a map, on any thread; its features stay in the file until an operation takes them.

    :raises StavprError: the file or the model does not do.
    """
    place_map = open_map(path)
    return LoadedMap(path, place_map, place_map.extractor(settings.backend, settings.model_path))


def begin(
    name: str, settings: PipelineSettings, place_map: PlaceMap | None, extractor: FeatureExtractor | None
) -> Operation | None:
    """
    Begin an operation; None where it lacks a map or a threshold.

    :param place_map: recognized on, or gone on with; loop closure begins a route of its own.
    :param extractor: that of the map; None without one, growing maps then take that of the settings.
    :raises StavprError: no such operation, settings that do not do, or a model that is not there.
    """
    if name not in OPERATIONS:
        raise SettingsError(f'operation {name!r} is unknown: take one of {", ".join(OPERATIONS)}')
    threshold = settings.applied_threshold(name)
    if name == 'localization':
        if place_map is None or extractor is None or threshold is None:
            return None
        return _warmed(Localization(place_map, extractor, settings, threshold), settings)
    extractor = extractor or settings.extractor()
    if name == 'mapping':
        return _mapping(settings, place_map, extractor)
    if threshold is None:
        return None
    loops = LoopClosure(extractor, settings, threshold)
    # with next to nothing excluded, so that few images do
    _warmed(LoopClosure(extractor, replace(settings, exclude_places=1), threshold), settings, more=8)
    return loops


def _mapping(settings: PipelineSettings, place_map: PlaceMap | None, extractor: FeatureExtractor) -> Operation:
    if place_map is not None:
        growing = GrowingMap.from_map(place_map, settings.max_places)
    else:
        growing = GrowingMap(extractor.settings, extractor.projection, settings.max_places)
    extractor.extract([BLANK])
    return Mapping(growing, extractor)


def _warmed(operation: Operation, settings: PipelineSettings, more: int = 0) -> Operation:
    """Compile and touch everything once, so that the first image is as fast as the rest."""
    features = operation.extractor.extract([BLANK])
    for _ in range(settings.sequence.length + more):
        operation.update(Observed(features, BLANK, 0, None, 0))
    operation.ranked(2)
    operation.reset()
    return operation
