# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the command ``evaluate``: folders, bags, saved maps, data sets, ground truth."""

import argparse
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
import time
import zipfile

import numpy as np
from stavpr_ros.commands.feature_options import kind_options, make_extractor
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.ground_truth_files import read_poses
from stavpr_ros.evaluation.paper.datasets import open_dataset
from stavpr_ros.evaluation.warp import cropped, FrameSource, warp_indices
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, load_map, PlaceMap
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag_file import is_bag
from stavpr_ros.sources.folder import text_of

IDENTITY_TOLERANCE = 3  # places; a file of accepted pairs includes its tolerance
DEFAULTS = {'features': 'gradient', 'strips': 7, 'seed': 0}


@dataclass(frozen=True)
class Sequences:
    """
    The inputs of an evaluation.

    :param reference: the map; None for loop closures.
    :param query: the query, with the changes of speed and width that the options name.
    :param unknown: a traverse through places that are not in the map, if there is one.
    :param ground_truth: of the query's images.
    :param tolerance: places.
    :param posed: the ground truth comes from poses.
    :param title: names of the inputs, a line.
    :param times: of the extraction of features, milliseconds an image.
    """

    reference: PlaceMap | None
    query: PlaceMap
    unknown: PlaceMap | None
    ground_truth: GroundTruth
    tolerance: int
    posed: bool
    title: str
    times: dict[str, float] = field(default_factory=dict)


def load_sequences(arguments: argparse.Namespace) -> Sequences:
    """
    Open the inputs that the parsed options name and extract their features.

    :raises StavprError: one cannot be read, or they do not fit together.
    """
    loader = _Loader(arguments)
    if arguments.dataset is not None:
        sequences = _of_dataset(arguments, loader)
    else:
        # saved maps first: they decide the features of the others
        paths = {'map': arguments.map, 'query': arguments.query, 'unknown': arguments.unknown}
        opened = {
            name: loader.load(name, path)
            for name, path in sorted(paths.items(), key=lambda item: not is_saved_map(item[1]))
            if path is not None
        }
        sequences = _of_paths(arguments, opened, loader.times)
    return sequences if arguments.warp is None else _warped(sequences, arguments.warp)


def is_saved_map(path: str | None) -> bool:
    """Return whether a path is a map file, by its content; False for an unreadable path."""
    return path is not None and os.path.isfile(path) and zipfile.is_zipfile(path)


class _Loader:
    """Extracts the same features of all inputs: those of the first saved map, or the options'."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._extractor: FeatureExtractor | None = None
        self._saved: PlaceMap | None = None
        self.times: dict[str, float] = {}

    def load(self, name: str, path: str) -> PlaceMap:
        """Open a folder, a bag or a saved map."""
        # unknown places are cropped as the query is
        kind = 'map' if name == 'map' else 'query'
        share = getattr(self._arguments, f'crop_{kind}')
        if is_saved_map(path):
            if share:
                raise SettingsError(f'--crop-{kind}: {path} is a saved map, which has no images')
            return self._load_map(path)
        if Path(path).suffix == '.stavpr':
            return load_map(path)  # raises the reason why it is none
        source = open_source(path, self._arguments.topic if is_bag(Path(path)) else None)
        return self.extract(name, cropped(source, *((0, share) if kind == 'map' else (share, 0))))

    def extract(self, name: str, source: FrameSource) -> PlaceMap:
        """Extract the features of a source."""
        extractor = self._chosen()
        began = time.perf_counter()
        extracted = build_map(source, extractor)
        milliseconds = (time.perf_counter() - began) * 1e3
        self.times[f'describing_{name}_ms_per_image'] = milliseconds / len(extracted)
        return extracted

    def _load_map(self, path: str) -> PlaceMap:
        """Load a saved map, and refuse options that contradict its features."""
        found = load_map(path)
        given = self._arguments
        first = self._extractor if self._saved is None else self._saved
        if first is not None:
            found.features.require_same_settings(first.settings, 'the first sequence')
            return found
        for name, requested, present in (
            ('features', given.features, found.settings.kind),
            ('strips', given.strips, found.settings.strips),
        ):
            if requested is not None and requested != present:
                raise SettingsError(
                    f'--{name} {requested}: the map {path} was made with {present}; leave it out'
                )
        model = f'--{found.settings.kind}-model'  # the file may have moved
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


def _of_dataset(arguments: argparse.Namespace, loader: _Loader) -> Sequences:
    name, separator, root = arguments.dataset.partition('=')
    if not separator:
        raise SettingsError(f'--dataset {arguments.dataset}: expected NAME=FOLDER')
    found = open_dataset(name, root, arguments.tolerance)
    return Sequences(
        reference=loader.extract('map', cropped(found.map, 0, arguments.crop_map)),
        query=loader.extract('query', cropped(found.query, arguments.crop_query, 0)),
        unknown=loader.load('unknown', arguments.unknown) if arguments.unknown else None,
        ground_truth=found.ground_truth,
        tolerance=found.tolerance,
        posed=False,
        title=name.replace('_', ' '),
        times=loader.times,
    )


def _of_paths(
    arguments: argparse.Namespace, opened: dict[str, PlaceMap], times: dict[str, float]
) -> Sequences:
    reference, query = opened.get('map'), opened['query']
    tolerance = arguments.tolerance
    if tolerance is None:
        tolerance = IDENTITY_TOLERANCE if arguments.truth == 'identity' else 0
    ground_truth = _ground_truth(arguments, query, reference or query, tolerance)
    if reference is None:
        # places are ``exclude_places`` images before the query and earlier
        ground_truth = ground_truth.loop_closures(arguments.exclude_places - 1)
        title = f'{_name(arguments.query)}: loop closures'
    else:
        title = f'{_name(arguments.query)} on the map {_name(arguments.map)}'
    posed = arguments.truth == 'poses'
    unknown = opened.get('unknown')
    return Sequences(reference, query, unknown, ground_truth, tolerance, posed, title, times)


def _name(path: str) -> str:
    return text_of(Path(path).resolve().name)


def _ground_truth(
    arguments: argparse.Namespace, query: PlaceMap, reference: PlaceMap, tolerance: int
) -> GroundTruth:
    N, n = len(query), len(reference)
    if arguments.truth == 'identity':
        return GroundTruth.identity(N, n, tolerance)
    if arguments.truth != 'poses':
        return GroundTruth.from_file(arguments.truth, N, n, tolerance)
    same = reference is query
    queries = _poses(arguments.query_poses, query, 'query', arguments.degrees)
    path = arguments.query_poses if same else arguments.map_poses
    places = _poses(path, reference, 'map', arguments.degrees)
    found = GroundTruth.from_poses(queries, places, arguments.meters, arguments.degrees)
    return found.widened(tolerance)


def _poses(path: str | None, place_map: PlaceMap, name: str, degrees: float | None) -> np.ndarray:
    """Return the poses of an input, from a file or from the saved map."""
    if path is None:
        if place_map.poses is None or not place_map.has_poses:
            raise SettingsError(f'--truth poses: the {name} has none, give --{name}-poses')
        return place_map.poses
    poses, oriented = read_poses(Path(path))
    if len(poses) != len(place_map):
        raise SourceError(
            f'{path} has {len(poses)} poses for {len(place_map)} images: give one each'
        )
    if degrees is not None and not oriented:
        raise SourceError(f'{path} has no orientations: leave --degrees out')
    return poses


def _warped(sequences: Sequences, kind: str) -> Sequences:
    """Change the query's speed: its images and their ground truth alike."""
    query = sequences.query
    indices = warp_indices(len(query), kind)
    changed = replace(
        query,
        features=query.features[indices],
        stamps=query.stamps[indices],
        ids=tuple(query.ids[i] for i in indices),
        poses=None if query.poses is None else query.poses[indices],
        thumbnails=tuple(query.thumbnails[i] for i in indices) if query.thumbnails else (),
    )
    return replace(
        sequences,
        query=changed,
        ground_truth=sequences.ground_truth.select(indices),
        title=f'{sequences.title}, speed {kind}',
    )
