"""How an operation begins: everything that may fail, and takes long, before anything is changed."""

from dataclasses import dataclass, replace

import numpy as np

from stavpr_ros.errors import SettingsError
from stavpr_ros.features import Describer
from stavpr_ros.mapping import GrowingMap, PlaceMap, load_map
from stavpr_ros.operation.operations import Localization, LoopClosure, Mapping, Observed, Operation
from stavpr_ros.operation.settings import OPERATIONS, EngineSettings

BLANK = np.zeros((480, 640, 3), np.uint8)


@dataclass(frozen=True)
class LoadedMap:
    """A map that was read, and what describes images as its were."""

    path: str
    places: PlaceMap
    describer: Describer


def read_map(path: str, settings: EngineSettings) -> LoadedMap:
    """
    Read a map, on any thread.

    :raises StavprError: the file or the model does not do.
    """
    place_map = load_map(path)
    return LoadedMap(path, place_map, place_map.describer(settings.backend, settings.model_path))


def begin(
    name: str, settings: EngineSettings, place_map: PlaceMap | None, describer: Describer | None
) -> Operation | None:
    """
    Begin an operation; None where it lacks a map or a threshold.

    :param place_map: recognised on, or gone on with; loop closure begins a route of its own.
    :param describer: that of the map; None without one, growing maps then take that of the settings.
    :raises StavprError: no such operation, settings that do not do, or a model that is not there.
    """
    if name not in OPERATIONS:
        raise SettingsError(f'operation {name!r} is unknown: take one of {", ".join(OPERATIONS)}')
    threshold = settings.applied_threshold(name)
    if name == 'localization':
        if place_map is None or describer is None or threshold is None:
            return None
        return _warmed(Localization(place_map, describer, settings, threshold), settings)
    describer = describer or settings.describer()
    if name == 'mapping':
        return _mapping(settings, place_map, describer)
    if threshold is None:
        return None
    loops = LoopClosure(describer, settings, threshold)
    # with next to nothing excluded, so that few images do
    _warmed(LoopClosure(describer, replace(settings, exclude_places=1), threshold), settings, more=8)
    return loops


def _mapping(settings: EngineSettings, place_map: PlaceMap | None, describer: Describer) -> Operation:
    if place_map is not None:
        growing = GrowingMap.from_map(place_map, settings.max_places)
    else:
        growing = GrowingMap(describer.settings, describer.projection, settings.max_places)
    describer.describe([BLANK])
    return Mapping(growing, describer)


def _warmed(operation: Operation, settings: EngineSettings, more: int = 0) -> Operation:
    """Compile and touch everything once, so that the first image is as fast as the rest."""
    features = operation.describer.describe([BLANK])
    for _ in range(settings.sequence.length + more):
        operation.add(Observed(features, BLANK, 0, None, 0))
    operation.ranked(2)
    operation.reset()
    return operation
