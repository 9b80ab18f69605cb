"""Opening what the command ``evaluate`` is given: folders, bags, saved maps, data sets, truth."""

import argparse
import os
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stavpr_ros.commands.feature_options import kind_options, make_extractor
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.ground_truth_files import read_poses
from stavpr_ros.evaluation.paper.datasets import open_dataset
from stavpr_ros.evaluation.warp import FrameSource, cropped, warp_indices
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import PlaceMap, build_map, load_map
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag import is_bag
from stavpr_ros.sources.folder import text_of

IDENTITY_TOLERANCE = 3  # places; a file of accepted pairs has its tolerance in it
DEFAULTS = {'features': 'gradient', 'strips': 7, 'seed': 0}


@dataclass(frozen=True)
class Drives:
    """
    What is evaluated.

    :param reference: the map; None where the query is its own.
    :param query: the query, changed as was asked for.
    :param truth: of the query's images.
    :param posed: the truth comes from poses.
    :param times: what describing took.
    """

    reference: PlaceMap | None
    query: PlaceMap
    unknown: PlaceMap | None
    truth: GroundTruth
    tolerance: int
    posed: bool
    title: str
    times: dict[str, float] = field(default_factory=dict)


def load_drives(arguments: argparse.Namespace) -> Drives:
    """
    Open, describe and change the drives that the parsed options name.

    :raises StavprError: one cannot be read, or they do not go together.
    """
    loader = _Loader(arguments)
    if arguments.dataset is not None:
        drives = _of_dataset(arguments, loader)
    else:
        # a saved map first: it decides how the others are described
        paths = {'map': arguments.map, 'query': arguments.query, 'unknown': arguments.unknown}
        opened = {
            name: loader.load(name, path)
            for name, path in sorted(paths.items(), key=lambda item: not is_saved_map(item[1]))
            if path is not None
        }
        drives = _of_paths(arguments, opened, loader.times)
    return drives if arguments.warp is None else _warped(drives, arguments.warp)


def is_saved_map(path: str | None) -> bool:
    """Tell whether a path is a map's file, by its content."""
    # what cannot be looked at is none: whoever opens it says why
    return path is not None and os.path.isfile(path) and zipfile.is_zipfile(path)


class _Loader:
    """Describes drives alike: as the first saved map was described, else as the options say."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._extractor: FeatureExtractor | None = None
        self._saved: PlaceMap | None = None
        self.times: dict[str, float] = {}

    def load(self, name: str, path: str) -> PlaceMap:
        """Open a folder, a bag or a saved map."""
        # what is unknown is seen through the query's eyes
        kind = 'map' if name == 'map' else 'query'
        share = getattr(self._arguments, f'crop_{kind}')
        if is_saved_map(path):
            if share:
                raise SettingsError(f'--crop-{kind}: {path} is a saved map, whose images are gone')
            return self._take(path)
        if Path(path).suffix == '.stavpr':
            return load_map(path)  # says what is wrong with it
        source = open_source(path, self._arguments.topic if is_bag(Path(path)) else None)
        return self.extract(name, cropped(source, *((0, share) if kind == 'map' else (share, 0))))

    def extract(self, name: str, source: FrameSource) -> PlaceMap:
        """Describe the images of a source."""
        extractor = self._chosen()
        began = time.perf_counter()
        described = build_map(source, extractor)
        self.times[f'describing_{name}_ms_per_image'] = (time.perf_counter() - began) * 1e3 / len(described)
        return described

    def _take(self, path: str) -> PlaceMap:
        found = load_map(path)
        given = self._arguments
        first = self._extractor if self._saved is None else self._saved
        if first is not None:
            found.features.require_same_settings(first.settings, 'the first drive')
            return found
        for name, wanted, there in (
            ('features', given.features, found.settings.kind),
            ('strips', given.strips, found.settings.strips),
        ):
            if wanted is not None and wanted != there:
                raise SettingsError(f'--{name} {wanted}: the map {path} was made with {there}; leave it out')
        model = f'--{found.settings.kind}-model'  # which may lie elsewhere now
        options = {'--projection': given.projection, '--seed': given.seed, **kind_options(given)}
        for option, value in options.items():
            if value is not None and option != model:
                raise SettingsError(f'{option}: the map {path} has its own or none; leave it out')
        self._saved = found
        return found

    def _chosen(self) -> FeatureExtractor:
        if self._extractor is None:
            given = self._arguments
            if self._saved is not None:
                model = getattr(given, f'{self._saved.settings.kind}_model', None)
                self._extractor = self._saved.extractor(choose_device(given.device), model or '')
            else:
                options = argparse.Namespace(**vars(given))
                for name, default in DEFAULTS.items():
                    if getattr(options, name) is None:
                        setattr(options, name, default)
                self._extractor = make_extractor(options)
        return self._extractor


def _of_dataset(arguments: argparse.Namespace, loader: _Loader) -> Drives:
    name, separator, root = arguments.dataset.partition('=')
    if not separator:
        raise SettingsError(f'--dataset {arguments.dataset}: expected NAME=FOLDER')
    found = open_dataset(name, root, arguments.tolerance)
    reference = loader.extract('map', cropped(found.map, 0, arguments.crop_map))
    query = loader.extract('query', cropped(found.query, arguments.crop_query, 0))
    unknown = loader.load('unknown', arguments.unknown) if arguments.unknown else None
    return Drives(
        reference, query, unknown, found.truth, found.tolerance, False, name.replace('_', ' '), loader.times
    )


def _of_paths(arguments: argparse.Namespace, opened: dict[str, PlaceMap], times: dict[str, float]) -> Drives:
    reference, query = opened.get('map'), opened['query']
    tolerance = arguments.tolerance
    if tolerance is None:
        tolerance = IDENTITY_TOLERANCE if arguments.truth == 'identity' else 0
    truth = _truth(arguments, query, reference or query, tolerance)
    title = f'{_name(arguments.query)} on the map {_name(arguments.map)}' if arguments.map else ''
    if reference is None:
        truth = truth.loop_closures(arguments.loop_closure - 1)  # places are N images back, and more
        title = f'{_name(arguments.query)}: loop closures'
    return Drives(
        reference, query, opened.get('unknown'), truth, tolerance, arguments.truth == 'poses', title, times
    )


def _name(path: str) -> str:
    return text_of(Path(path).resolve().name)


def _truth(
    arguments: argparse.Namespace, query: PlaceMap, reference: PlaceMap, tolerance: int
) -> GroundTruth:
    N, n = len(query), len(reference)
    if arguments.truth == 'identity':
        return GroundTruth.identity(N, n, tolerance)
    if arguments.truth != 'poses':
        return GroundTruth.from_file(arguments.truth, N, n, tolerance)
    same = reference is query
    files = (arguments.query_poses, arguments.query_poses if same else arguments.map_poses)
    poses = [
        _poses(path, place_map, name, arguments.degrees)
        for path, place_map, name in zip(files, (query, reference), ('query', 'map'), strict=True)
    ]
    return GroundTruth.from_poses(poses[0], poses[1], arguments.meters, arguments.degrees).widened(
        arguments.tolerance or 0
    )


def _poses(path: str | None, place_map: PlaceMap, name: str, degrees: float | None) -> np.ndarray:
    """Return the poses of a drive, from a file or from the saved map."""
    if path is None:
        if place_map.poses is None or not place_map.has_poses:
            raise SettingsError(f'--truth poses: the {name} has none, give --{name}-poses')
        return place_map.poses
    poses, oriented = read_poses(Path(path))
    if len(poses) != len(place_map):
        raise SourceError(f'{path} has {len(poses)} poses for {len(place_map)} images: give one each')
    if degrees is not None and not oriented:
        raise SourceError(f'{path} has no orientations: leave --degrees out')
    return poses


def _warped(drives: Drives, kind: str) -> Drives:
    """Change the query's speed, features and truth alike."""
    indices = warp_indices(len(drives.query), kind)
    query, features = drives.query, drives.query.features
    changed = PlaceMap(
        features=LocalFeatures(
            features.strips[:, indices].contiguous(),
            features.weights[:, indices].contiguous(),
            features.settings,
            features.cells,
        ),
        projection=query.projection,
        stamps=query.stamps[indices],
        ids=tuple(query.ids[i] for i in indices),
        poses=None if query.poses is None else query.poses[indices],
        thumbnails=tuple(query.thumbnails[i] for i in indices) if query.thumbnails else (),
    )
    return Drives(
        drives.reference, changed, drives.unknown, drives.truth.select(indices), drives.tolerance,
        drives.posed, f'{drives.title}, speed {kind}', drives.times,
    )  # fmt: skip
