# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the command ``evaluate``: images, maps, data sets, ground truth, settings."""

import argparse
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np
from stavpr_lab.evaluation.drive import crop, Drive, DriveChanges, FrameSource
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.paper.datasets import open_dataset
from stavpr_lab.features.descriptors import is_descriptors, read_descriptors, require_comparable
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.commands.feature_options import kind_options, make_extractor
from stavpr_ros.errors import left_out, SettingsError, SourceError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import AUTO
from stavpr_ros.maintenance.same_places import repeats_of, with_repeats
from stavpr_ros.mapping import build_map, descriptor_map, is_map, load_map, Map, select_places
from stavpr_ros.mapping.builder import fit_value_range
from stavpr_ros.mapping.merging import along_route
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.parameters import default
from stavpr_ros.sources import is_folder, open_source
from stavpr_ros.sources.bag_path import is_bag
from stavpr_ros.sources.folder import text_of
from stavpr_ros.sources.pose_file import read_poses
from stavpr_ros.sources.video import require_video

IDENTITY_TOLERANCE = 3  # places; a file of accepted pairs includes its tolerance
DEFAULTS = {'features': default('features'), 'seed': 0}


@dataclass(frozen=True)
class Sequences:
    """
    The inputs of an evaluation.

    :param reference: the map; None for loop closures.
    :param query: the query, with the changes that the options name.
    :param unknown: a traverse through places that are not in the map, if there is one.
    :param drive: these changes, and the ground truth of the query's images.
    :param tolerance: places.
    :param title: names of the inputs, a line.
    :param times: duration of the extraction of features, milliseconds an image.
    :param odometry: poses of the query's images by odometry, (N, 7); None = unknown.
    """

    reference: Map | None
    query: Map
    unknown: Map | None
    drive: Drive
    tolerance: int
    title: str
    times: dict[str, float] = field(default_factory=dict)
    odometry: np.ndarray | None = None


def load_sequences(arguments: argparse.Namespace) -> Sequences:
    """
    Open the inputs that the parsed options name and extract their features.

    :raises StavprError: one cannot be read, or they do not fit together.
    """
    loader = _Loader(arguments)
    if arguments.dataset is not None:
        sequences = _of_dataset(arguments, loader)
    else:
        paths = {'map': arguments.map, 'query': arguments.query, 'unknown': arguments.unknown}
        require_video(arguments.fps, paths.values())
        # saved maps first: they decide the features of the others
        inputs = {
            name: loader.load(name, path)
            for name, path in sorted(paths.items(), key=_decides_features)
            if path is not None
        }
        if 'map' in inputs and not is_saved_map(arguments.map):
            inputs['map'] = with_repeats(inputs['map'])
            if note := repeats_of(inputs['map']):
                print(note, file=sys.stderr)
        sequences = _of_paths(arguments, inputs, loader.times)
    if unread := left_out(loader.left_out):
        print(unread, file=sys.stderr)
    return _change_drive(sequences, arguments)


def recognizer_settings(arguments: argparse.Namespace) -> RecognizerSettings:
    """
    Return the settings of the parsed options, without a threshold.

    :raises SettingsError: one is out of its range.
    """
    return RecognizerSettings(
        mode=arguments.mode,
        min_probability=arguments.min_probability,
        max_error=arguments.max_error,
        direction=arguments.direction,
        spatial=SpatialSettings(
            arguments.strategy, arguments.sigma, arguments.xi, arguments.vertical
        ),
        sequence=SequenceSettings(arguments.sequence_length, arguments.beta),
        nms_radius=arguments.nms_radius,
    )


def settings_json(arguments: argparse.Namespace, sequences: Sequences) -> dict[str, Any]:
    """Return everything that decides the numbers."""
    poses = ('query_poses', 'map_poses', 'meters', 'degrees') if arguments.truth == 'poses' else ()
    names = [
        *('map', 'query', 'dataset', 'topic', 'fps', 'camera', 'unknown', 'loop_closure'),
        *('exclude_places', 'remove_from_map', 'reverse', 'speed', 'stop', 'drop', 'drop_seed'),
        *('crop_map', 'crop_query', 'truth', *poses),
        *('mode', 'min_probability', 'max_error', 'sequence_length', 'beta', 'nms_radius'),
        'direction',
        *('strategy', 'sigma', 'xi', 'vertical'),
        *('backend', 'precision', 'late_closures', 'odometry'),
    ]
    settings: dict[str, Any] = {}
    for name in names:
        value = getattr(arguments, name)
        settings[name] = text_of(value) if isinstance(value, str) else value
    features = sequences.query.settings.to_json()
    return {**settings, 'tolerance': sequences.tolerance, 'features': features}


def is_saved_map(path: str | None) -> bool:
    """Return whether a path is a map file, by its content; False for an unreadable path."""
    return path is not None and Path(path).is_file() and is_map(path)


def _decides_features(item: tuple[str, str | None]) -> int:
    """Order saved maps first, then descriptors."""
    return 0 if is_saved_map(item[1]) else 1 if is_descriptors(item[1]) else 2


class _Loader:
    """Extracts the same features of all inputs, as of the first saved map or by the options."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._extractor: FeatureExtractor | None = None
        self._saved: Map | None = None
        self.times: dict[str, float] = {}
        self.left_out: Counter[str] = Counter()

    def load(self, name: str, path: str) -> Map:
        """Open a folder, a video, a bag, a saved map or descriptors."""
        if is_saved_map(path) or is_descriptors(path):
            option = 'crop_map' if name == 'map' else 'crop_query'
            if getattr(self._arguments, option):
                raise SettingsError(
                    f'--{option.replace("_", "-")}: {path} is a saved map or an array, which has '
                    'no images'
                )
            return self._read(path) if is_descriptors(path) else self._load_map(path)
        if Path(path).suffix == '.stavpr':
            return load_map(path)  # raises the reason why it is none
        topic = self._arguments.topic if is_bag(Path(path)) else None
        camera = self._arguments.camera if is_folder(path) else None
        source = open_source(path, topic, fps=self._arguments.fps, camera=camera)
        extracted = self.extract(name, source)
        self.left_out.update(getattr(source, 'left_out', {}))
        return extracted

    def extract(self, name: str, source: FrameSource) -> Map:
        """Extract the features of a source, cropped as the options state."""
        args, extractor = self._arguments, self._chosen()
        fit_value_range(source, extractor)
        # unknown places are cropped as the query is
        source = crop(source, *((0, args.crop_map) if name == 'map' else (args.crop_query, 0)))
        began = time.perf_counter()
        extracted = build_map(source, extractor)
        milliseconds = (time.perf_counter() - began) * 1e3
        self.times[f'describing_{name}_ms_per_image'] = milliseconds / len(extracted)
        return extracted

    def _read(self, path: str) -> Map:
        """Read descriptors; the map's and the query's must be comparable."""
        args = self._arguments
        names = 'features', 'strips', 'projection'
        options = {f'--{name}': getattr(args, name) for name in names} | kind_options(args)
        for option, value in options.items():
            if value is not None:
                raise SettingsError(
                    f'{option}: {path} holds descriptors as they are; leave it out'
                )
        source, bits = args.descriptors_source, args.descriptors_bits
        first = self._saved
        if first is not None and first.settings.kind == 'descriptors':
            own = first.settings.backbone
            source = own.source if source is None else source
            bits = own.bits if bits is None else bits
        features = read_descriptors(path, source or '', bool(bits))
        if first is not None:
            require_comparable(features, first.settings, first.dimension)
        place_map = descriptor_map(features)
        self._saved = first or place_map
        return place_map

    def _load_map(self, path: str) -> Map:
        """Load a saved map, and refuse options that contradict its features."""
        place_map = load_map(path)
        args = self._arguments
        first = self._extractor if self._saved is None else self._saved
        if first is not None:
            place_map.features.require_same_settings(first.settings, 'the first sequence')
            return place_map
        own = {'features': place_map.settings.kind, 'strips': place_map.settings.strips}
        for name, present in own.items():
            request = getattr(args, name)
            if request not in (None, AUTO, present):
                raise SettingsError(
                    f'--{name} {request}: the map {path} was made with {present}; leave it out'
                )
        # a map does not state where its model is
        usable = f'--{place_map.settings.kind}-model'
        options = {'--projection': args.projection, '--seed': args.seed, **kind_options(args)}
        for option, value in options.items():
            if value is not None and option != usable:
                raise SettingsError(f'{option}: the map {path} has its own or none; leave it out')
        self._saved = place_map
        return place_map

    def _chosen(self) -> FeatureExtractor:
        if self._extractor is None:
            args = self._arguments
            if self._saved is not None:
                model = getattr(args, f'{self._saved.settings.kind}_model', None)
                self._extractor = self._saved.extractor(args.device, model or '')
            else:
                values = {name: value for name, value in vars(args).items() if value is not None}
                options = argparse.Namespace(**(vars(args) | DEFAULTS | values))
                self._extractor = make_extractor(options)
        return self._extractor


def _of_dataset(arguments: argparse.Namespace, loader: _Loader) -> Sequences:
    name, separator, root = arguments.dataset.partition('=')
    if not separator:
        raise SettingsError(f'--dataset {arguments.dataset}: expected NAME=FOLDER')
    data_set = open_dataset(name, root, arguments.tolerance)
    return Sequences(
        reference=loader.extract('map', data_set.map),
        query=loader.extract('query', data_set.query),
        unknown=loader.load('unknown', arguments.unknown) if arguments.unknown else None,
        drive=DriveChanges().apply(data_set.ground_truth),
        tolerance=data_set.tolerance,
        title=name.replace('_', ' '),
        times=loader.times,
    )


def _of_paths(
    arguments: argparse.Namespace, inputs: dict[str, Map], times: dict[str, float]
) -> Sequences:
    reference, query = inputs.get('map'), inputs['query']
    tolerance = arguments.tolerance
    if tolerance is None:
        tolerance = IDENTITY_TOLERANCE if arguments.truth == 'identity' else 0
    ground_truth = _ground_truth(arguments, query, reference or query, tolerance)
    if doubt := ground_truth.doubt():
        print(f'the ground truth accepts {doubt}', file=sys.stderr)
    if reference is not None and np.array_equal(reference.features.strips, query.features.strips):
        print('map and query are the same images: each is recognized by itself', file=sys.stderr)
    if reference is None:
        # places are ``exclude_places`` images before the query and earlier
        ground_truth = ground_truth.loop_closures(arguments.exclude_places - 1)
        title = f'{_name(arguments.query)}: loop closures'
    else:
        title = f'{_name(arguments.query)} on the map {_name(arguments.map)}'
    unknown = inputs.get('unknown')
    drive = DriveChanges().apply(ground_truth)
    odometry = None
    if arguments.odometry is not None:
        odometry = poses_of(arguments.odometry, query, 'query', None)
        if reference is not None:
            reference = replace(
                reference, poses=poses_of(arguments.map_poses, reference, 'map', None)
            )
    return Sequences(reference, query, unknown, drive, tolerance, title, times, odometry)


def _name(path: str) -> str:
    return text_of(Path(path).resolve().name)


def _ground_truth(
    arguments: argparse.Namespace, query: Map, reference: Map, tolerance: int
) -> GroundTruth:
    N, n = len(query), len(reference)
    if arguments.truth is None:
        return GroundTruth.unknown(N, n)
    if arguments.truth == 'identity':
        truth = GroundTruth.identity(N, n)
        return truth.widened(tolerance, along_route(reference)[0])
    if arguments.truth != 'poses':
        truth = GroundTruth.from_file(arguments.truth, N, n, names=(query.ids, reference.ids))
        return truth.widened(tolerance, along_route(reference)[0])
    same = reference is query
    queries = poses_of(arguments.query_poses, query, 'query', arguments.degrees)
    path = arguments.query_poses if same else arguments.map_poses
    places = poses_of(path, reference, 'map', arguments.degrees)
    truth = GroundTruth.from_poses(queries, places, arguments.meters, arguments.degrees)
    return truth.widened(tolerance)


def poses_of(path: str | None, place_map: Map, name: str, degrees: float | None) -> np.ndarray:
    """Return the poses of an input, from a file or from the saved map."""
    if path is None:
        if place_map.poses is None or not place_map.has_poses:
            raise SettingsError(f'the {name} has no poses: give --{name}-poses')
        return place_map.poses
    poses, has_orientations = read_poses(Path(path), place_map.ids)
    if len(poses) != len(place_map):
        raise SourceError(
            f'{path} has {len(poses)} poses for {len(place_map)} images: give one each'
        )
    if degrees is not None and not has_orientations:
        raise SourceError(f'{path} has no orientations: leave --degrees out')
    return poses


def _change_drive(sequences: Sequences, arguments: argparse.Namespace) -> Sequences:
    """Drive the query as the options want it, on a map without the places that they remove."""
    query, reference = sequences.query, sequences.reference
    warp = DriveChanges.from_name(arguments.speed or 'same', len(query))
    changes = replace(
        warp,
        removed=tuple(arguments.remove_from_map),
        reverse=arguments.reverse,
        drop=arguments.drop,
        seed=arguments.drop_seed,
        stops=(*warp.stops, *arguments.stop),
    )
    if changes == DriveChanges(seed=changes.seed):
        return sequences
    drive = changes.apply(sequences.drive.recorded)
    if reference is not None and changes.removed:
        reference = select_places(reference, drive.places)
    title = f'{sequences.title}, {_description(arguments)}'
    if replace(changes, removed=()) != DriveChanges(seed=changes.seed):
        query = replace(select_places(query, drive.images), stamps=drive.stamps)
    odometry = None if sequences.odometry is None else sequences.odometry[drive.images]
    return replace(
        sequences, reference=reference, query=query, drive=drive, title=title, odometry=odometry
    )


def _description(arguments: argparse.Namespace) -> str:
    """Return the changes of the drive as text of the title."""
    parts = [f'without places {a} .. {b - 1}' for a, b in arguments.remove_from_map]
    parts += ['reverse'] if arguments.reverse else []
    if arguments.speed:
        parts.append(f'speed {arguments.speed}')
    if arguments.drop:
        parts.append(f'drop {arguments.drop:g}')
    parts += [f'stop {image}:{count}' for image, count in arguments.stop]
    return ', '.join(parts)
