"""The demonstration of loop closure: one drive, replayed into the node, recognized on its own past."""

import argparse
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stavpr_ros.commands.demo import CHECK, EXCLUDE, TOPIC, extract_map, image_records, make_room, say
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.evaluation.records import IN_WINDOW
from stavpr_ros.evaluation.ground_truth import GroundTruth

if TYPE_CHECKING:
    from stavpr_ros.features import FeatureExtractor


@dataclass(frozen=True)
class LoopDrive:
    """
    A drive that comes back to where it was.

    :param truth: (later, earlier) images of one place, shape (M, 2); a file that says so; or None.
    """

    path: str
    topic: str | None
    truth: np.ndarray | str | None
    title: str


@dataclass(frozen=True)
class LoopResult:
    """
    The loop closures of N images, in numbers of images.

    :param closures: (query, place) of each, shape (C, 2).
    :param distances: of each, shape (C,).
    :param pairs: (later, earlier) images that some closure aligns, each once, shape (M, 2).
    :param truth: right pairs; None = unknown.
    :param exclude: the latest images that were not compared.
    :param skipped: images that were too like the last keyframe.
    """

    N: int
    closures: np.ndarray
    distances: np.ndarray
    pairs: np.ndarray
    truth: GroundTruth | None
    exclude: int
    skipped: int

    @property
    def right(self) -> np.ndarray | None:
        """Tell which closures are right, shape (C,), bool."""
        return self.are_right(self.closures)

    def are_right(self, pairs: np.ndarray) -> np.ndarray | None:
        """Tell which pairs of images, shape (M, 2), are right, shape (M,), bool; None = unknown."""
        if self.truth is None:
            return None
        return np.isin(pairs[:, 0] * self.N + pairs[:, 1], self.truth.keys)

    def lines(self) -> list[str]:
        """Say what came out, a line each."""
        C = len(self.closures)
        said = [f'{C} loop closures in {self.N} images ({self.skipped} were too like the one before)']
        if self.truth is None or self.right is None:
            return said
        right = np.count_nonzero(self.right)
        of_closures = f', precision {right / C:.3f}' if C else ''
        said.append(f'{right} of {C} loop closures are right{of_closures}')
        seen = self.truth.has_match
        aligned = self.pairs[self.are_right(self.pairs)]
        closed = len(np.unique(aligned[:, 0]))
        share = f', recall {closed / seen.sum():.3f}' if seen.any() else ''
        said.append(
            f'{closed} of {np.count_nonzero(seen)} images of places passed before are in a right pair{share}'
        )
        return said


def read_result(
    matches: list[dict[str, Any]], closures: list[dict[str, Any]], truth: GroundTruth | None, exclude: int
) -> LoopResult:
    """
    Bring what was heard together.

    :param matches: one an image, of the command ``record``; they tell which images became places.
    :param closures: of ``record --loop-closures``.
    """
    images = np.array([i for i, match in enumerate(matches) if match['status'] in IN_WINDOW], np.int64)
    ends = [[closure['query_index'], closure['place_index']] for closure in closures]
    pairs = [[pair[0], pair[2]] for closure in closures for pair in closure['pairs']]
    return LoopResult(
        len(matches),
        images[np.array(ends, np.int64).reshape(-1, 2)],
        np.array([closure['distance'] for closure in closures], float),
        images[np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)],
        truth,
        exclude,
        sum(match['status'] == 'SKIPPED' for match in matches),
    )


def _make_world(folder: Path, seed: int) -> LoopDrive:
    """Drive twice through a made-up street, in the afternoon on the other lane, and write one bag."""
    from stavpr_ros.demonstration.street import GOOD_LIGHT, World, first_drive, ground_truth, second_drive
    from stavpr_ros.sources.bag_writer import write_bag

    say('1. One drive twice along a made-up street, the second time on the other lane and with a detour')
    make_room(folder / 'loop')
    later = replace(
        GOOD_LIGHT, sun=0.25, sun_azimuth=250.0, sun_elevation=20.0, clouds=0.7, ambient=0.55, warmth=0.08,
        lane=-1.0, traffic=2,
    )  # fmt: skip
    world = World(seed)
    first = first_drive(world)
    second = second_drive(world, conditions=later)
    epoch = int(first.stamps[-1] + first.stamps[1] - first.stamps[0])

    def both() -> Any:
        yield from image_records(first, 'first time')
        yield from image_records(second, 'second time', epoch)

    write_bag(folder / 'loop', TOPIC, both())
    places = ground_truth(first, second)
    again = np.flatnonzero(places >= 0)
    truth = np.stack([again + len(first), places[again]], axis=1)
    return LoopDrive(str(folder / 'loop'), TOPIC, truth, 'A made-up street, driven along twice')


def _users_drive(arguments: argparse.Namespace) -> LoopDrive:
    say(f'1. Your drive: {arguments.loop}')
    title = f'{Path(arguments.loop).resolve().name}: loops that the node closed'
    return LoopDrive(arguments.loop, arguments.topic, arguments.truth, title)


def _truth(drive: LoopDrive, N: int, exclude: int, tolerance: int) -> GroundTruth | None:
    if drive.truth is None:
        return None
    if isinstance(drive.truth, str):
        truth = GroundTruth.from_file(drive.truth, N, N, tolerance)
    else:
        truth = GroundTruth.from_pairs(drive.truth[:, 0], drive.truth[:, 1], N, N, tolerance)
    return truth.loop_closures(exclude - 1)  # places are so many images back, and more


def _save_features(drive: LoopDrive, extractor: 'FeatureExtractor', path: Path) -> None:
    """Write a map of one image: in operation loop_closure, a map tells what features to make, and no more."""
    from stavpr_ros.mapping import build_map, save_map
    from stavpr_ros.sources import open_source

    readable = iter(open_source(drive.path, drive.topic, lambda error: None))
    save_map(build_map(islice(readable, 1), extractor, thumbnails=False, progress=False), path)


def close_loops(arguments: argparse.Namespace, folder: Path) -> None:
    """
    Run the demonstration.

    :param folder: where all is written.
    :raises StavprError: something failed.
    """
    from stavpr_ros.commands.feature_options import make_extractor
    from stavpr_ros.demonstration.loop_plots import draw_loops
    from stavpr_ros.recognition.robust.options import LOOP_THRESHOLD
    from stavpr_ros.ros.live import run_loop_closure
    from stavpr_ros.sources import open_source

    drive = _users_drive(arguments) if arguments.loop else _make_world(folder, arguments.world_seed)
    length, exclude = arguments.sequence_length, arguments.exclude or EXCLUDE
    N = len(open_source(drive.path, drive.topic))
    if exclude + length >= N:
        raise SettingsError(f'{drive.path} has {N} images: --exclude {exclude} leaves no window of {length}')
    extractor = make_extractor(arguments)
    extracted = extract_map(drive.path, drive.topic, extractor)
    if drive.truth is not None and len(extracted) != N:
        raise SourceError('images were skipped: the truth of the others is not known; repair or remove them')
    truth = _truth(drive, len(extracted), exclude, arguments.tolerance)
    features = folder / 'features.stavpr'
    _save_features(drive, extractor, features)

    say('2. The drive through the node, over ROS, with replay and listeners as processes of their own')
    threshold = arguments.threshold or LOOP_THRESHOLD
    parameters = {
        'map_path': features,
        'mode': arguments.mode,
        'threshold': threshold,
        'sequence_length': length,
        'exclude_places': exclude,
        'geometric_check': arguments.check or CHECK,
    }
    matches, closures = run_loop_closure(parameters, drive.path, len(extracted), folder, drive.topic)
    result = read_result(matches, closures, truth, exclude)
    picture = draw_loops(result, extracted, drive.title, folder)
    say('\n3. What came out')
    for line in result.lines():
        say(f'   {line}')
    say(f'   loop_closures.jsonl and the rest are in {folder}/; look at {picture}')
