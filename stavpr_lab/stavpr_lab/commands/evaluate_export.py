# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of ``evaluate --export``: arrays, and files that programs of other groups read."""

import argparse
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from stavpr_ros.commands.program import say
from stavpr_ros.errors import SourceError
from stavpr_ros.output_file import ANY, atomic_output, NPY, require_replaceable, write_output

if TYPE_CHECKING:
    from stavpr_lab.evaluation.report import Report
    from stavpr_ros.features import LocalFeatures
    from stavpr_ros.method import RecognizerSettings

FORMATS = {  # their files
    'arrays': ('map.npy', 'query.npy'),
    'vpr_methods_evaluation': ('database_descriptors.npy', 'queries_descriptors.npy'),
    'vpr_tutorial': ('S.npy', 'GT.npz'),
    'hloc': ('pairs.txt',),
}
RADIUS = 25.0  # meters, of VPR-methods-evaluation; positions by index are scaled to it


def require_exportable(arguments: argparse.Namespace) -> None:
    """Make the folder, and reject the files of an earlier export without ``--force``."""
    folder = Path(arguments.export)
    folder.mkdir(parents=True, exist_ok=True)
    for name in FORMATS[arguments.export_format]:
        kind = NPY if name.endswith('.npy') else ANY
        require_replaceable(folder / name, kind, arguments.force)


def export(
    arguments: argparse.Namespace, report: 'Report', settings: 'RecognizerSettings'
) -> None:
    """Write the files of a format; ``settings`` are the recognizer's."""
    folder, force = Path(arguments.export), arguments.force
    if arguments.export_format == 'vpr_tutorial':
        _write_matrices(report, settings, folder, force)
    elif arguments.export_format == 'hloc':
        _write_pairs(report, _image_files(arguments, report), folder, force)
    elif arguments.export_format == 'vpr_methods_evaluation':
        files, positions = _image_files(arguments, report), _positions(arguments, report)
        for i, name in enumerate(('database', 'queries')):
            rows = image_vectors((report.reference, report.query)[i].features)
            _write_npy(folder / f'{name}_descriptors.npy', rows, force)
            _link_images(files[i], positions[i], folder / name)
    else:
        _write_npy(folder / 'query.npy', image_strips(report.query.features), force)
        if report.reference is not report.query:
            _write_npy(folder / 'map.npy', image_strips(report.reference.features), force)
    say(f'{arguments.export_format}: {folder}')


def image_strips(features: 'LocalFeatures') -> np.ndarray:
    """
    Return the strips of each image, each with its share of the norm, as descriptors are read.

    :returns: shape (n, W, d), float32; (n, d) if W = 1.
    """
    strips = (features.strips * features.weights[:, :, None]).transpose(1, 0, 2)
    return strips[:, 0] if strips.shape[1] == 1 else strips


def image_vectors(features: 'LocalFeatures') -> np.ndarray:
    """Return a unit-norm vector of each image, its strips side by side, shape (n, W d)."""
    return image_strips(features).reshape(len(features), -1)


def _image_files(arguments: argparse.Namespace, report: 'Report') -> list[list[Path]]:
    """Return the files of the places and of the query's images."""
    pairs = ((arguments.map, report.reference), (arguments.query, report.query))
    if not all(path and Path(path).is_dir() for path, _ in pairs):
        raise SourceError('the export names image files: give --map and --query as folders')
    return [[Path(path, name) for name in traverse.ids] for path, traverse in pairs]


def _positions(arguments: argparse.Namespace, report: 'Report') -> list[np.ndarray | None]:
    """Return x and y of places and images that express the ground truth; None = unknown."""
    from stavpr_ros.sources.folder import FolderSource
    from stavpr_ros.sources.pose_file import read_poses

    indices = report.drive.places, report.drive.images
    if arguments.truth == 'identity':
        spacing = RADIUS / (report.settings['tolerance'] + 0.5)
        return [np.outer(index, (0, spacing)) for index in indices]
    if arguments.truth != 'poses':
        return [None, None]
    files = (arguments.map, arguments.map_poses), (arguments.query, arguments.query_poses)
    traverses = report.reference, report.query
    return [
        (
            read_poses(Path(path), FolderSource(folder, camera=arguments.camera).names)[0][index]
            if path
            else np.asarray(traverse.poses)
        )[:, :2]
        for (folder, path), traverse, index in zip(files, traverses, indices, strict=True)
    ]


def _link_images(files: list[Path], positions: np.ndarray | None, folder: Path) -> None:
    """Link images under names with their positions, and list these names in their order."""
    folder.mkdir(exist_ok=True)
    names = []
    for i, file in enumerate(files):
        utm = '@@' if positions is None else f'@{positions[i, 0]:.2f}@{positions[i, 1]:.2f}'
        names.append(f'{utm}@@@@@{i:06d}@@@@@@@@{file.suffix.lower()}')
        (folder / names[-1]).unlink(missing_ok=True)
        (folder / names[-1]).symlink_to(file.resolve())
    list_file = folder.with_name(f'{folder.name}_images_paths.txt')
    write_output(list_file, '\n'.join(names) + '\n', ANY, force=True)


def _write_matrices(
    report: 'Report', settings: 'RecognizerSettings', folder: Path, force: bool
) -> None:
    """Write similarities of single images and the ground truth; rows are places."""
    from stavpr_ros.method import PlaceRecognizer

    distances = PlaceRecognizer(report.reference, settings).distances(report.query.features)
    _write_npy(folder / 'S.npy', 1 - distances.T, force)
    correct = np.zeros(distances.T.shape, bool)
    correct[tuple(report.evaluation.ground_truth.pairs.T[::-1])] = True
    content = io.BytesIO()
    np.savez_compressed(content, GThard=correct, GTsoft=correct)
    write_output(folder / 'GT.npz', content.getvalue(), ANY, force)


def _write_pairs(report: 'Report', files: list[list[Path]], folder: Path, force: bool) -> None:
    """Write the best places of each window, a line a pair: query and reference."""
    root = os.path.commonpath([file.parent.absolute() for side in files for file in side])
    places, queries = ([os.path.relpath(file, root) for file in side] for side in files)
    if bad := [name for name in (*places, *queries) if len(name.split()) > 1]:
        raise SourceError(f'{bad[0]!r} has a space, which separates names in pairs.txt: rename')
    ranked = report.evaluation.results.sequence.places
    pairs = [(queries[i], places[k]) for i, row in enumerate(ranked) for k in row[row >= 0]]
    write_output(folder / 'pairs.txt', ''.join(f'{q} {r}\n' for q, r in pairs), ANY, force)


def _write_npy(path: Path, array: np.ndarray, force: bool) -> None:
    with atomic_output(path, NPY, force) as file:
        np.save(file, np.ascontiguousarray(array, np.float32))
