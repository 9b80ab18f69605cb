# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Golden streams: drives of 100 images each, and all that the package answers to them.

``python test/shared/golden.py`` writes the file that test_golden_streams.py compares with, a short
row per image. With ``--all FILE``, every bit of every answer, for ``benchmarks/compare.py``.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
import enum
import importlib.util
import json
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from places import poses_at
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures
from stavpr_ros.mapping import build_map, descriptor_map, Map, merge_maps
from stavpr_ros.method import Match, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.verification import GeometricSettings
from stavpr_ros.pipeline import Pipeline, PipelineSettings
from stavpr_ros.pipeline.pipeline import LoadedMap
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.sources.frame import Frame, ImageRecord

FILE = Path(__file__).with_name('golden_streams.json')
STEP, HEIGHT, WIDTH = 24, 96, 128  # pixels from place to place, and of a view
PLACES, IMAGES, SECOND = 110, 100, 10**9
SCALES = (32, 16, 8)  # pixels of the squares of a texture


def texture(seed: int) -> np.ndarray:
    """Return a wall along a route, whole numbers only: the same on every processor."""
    rng, width = np.random.default_rng(seed), (PLACES + 10) * STEP
    total = np.zeros((HEIGHT, width, 3), np.int32)
    for size in SCALES:
        squares = rng.integers(0, 256, (HEIGHT // size, width // size + 1, 3))
        total += np.kron(squares, np.ones((size, size, 1), np.int64))[:, :width]
    return total // len(SCALES)


def views(
    positions: Any, wall: int = 0, gain: float = 1, noise: int = 0, seed: int = 1
) -> list[np.ndarray]:
    """Return images, RGB uint8, at positions along a wall, in places."""
    rng, pixels, images = np.random.default_rng(seed), texture(wall), []
    for position in positions:
        begin = round(position * STEP)
        image = pixels[:, begin : begin + WIDTH] * round(64 * gain) // 64
        image = image + rng.integers(-noise, noise + 1, image.shape)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    return images


def map_of(images: list[np.ndarray], poses: np.ndarray | None = None) -> Map:
    frames = [Frame(image, (i + 1) * SECOND, f'{i}') for i, image in enumerate(images)]
    return build_map(frames, FeatureExtractor('gradient'), poses, progress=False)


def route_map(has_poses: bool = False) -> Map:
    return map_of(views(range(PLACES)), poses_at(range(PLACES)) if has_poses else None)


@dataclass
class Drive:
    """
    What a pipeline is given.

    :param places: the map; None = a route that grows.
    :param images: of the drive, a second apart; poses: of the camera, (m, 7), or None.
    """

    places: Map | None
    images: list[np.ndarray]
    settings: dict[str, Any] = field(default_factory=dict)
    poses: np.ndarray | None = None

    def pipeline(self) -> Pipeline:
        common = {'backend': 'cpu', 'features': 'gradient', 'nms_radius': 5, 'candidates': 3}
        settings = PipelineSettings(**common | self.settings)
        if self.places is None:
            return Pipeline(settings, 'loop_closure')
        pipeline = Pipeline(settings)
        pipeline.change(loaded=LoadedMap('map', self.places, self.places.extractor()))
        return pipeline

    def process(self, pipeline: Pipeline, count: int = IMAGES) -> list[ImageResult]:
        """Return the results of the first images."""
        return [
            pipeline.operation.process(
                ImageRecord.of_image(image, 0),
                (i + 1) * SECOND,
                None if self.poses is None else self.poses[i],
            )
            for i, image in enumerate(self.images[:count])
        ]


def dusk(positions: Any, **others: Any) -> list[np.ndarray]:
    """Return views of another light than the map's, half a place further."""
    return views(np.asarray(positions) + 0.5, **{'gain': 0.6, 'noise': 20} | others)


def robust() -> Drive:
    speeds = np.repeat([1.0, 0.7, 1.3], [40, 30, 30])
    return Drive(route_map(), dusk(np.cumsum(speeds)))


def paper() -> Drive:
    return Drive(route_map(), dusk(np.arange(IMAGES)), {'mode': 'paper', 'threshold': 0.265})


def loop_closure() -> Drive:
    once = views(np.arange(55))
    return Drive(None, once + views(np.arange(8, 53), noise=12), {'exclude_places': 25})


def late() -> Drive:
    """Return a second lap that begins in the dark."""
    again = views(np.arange(5, 50), noise=6)
    again[:12] = dusk(np.arange(5, 17), gain=0.4, noise=30)
    return Drive(None, views(np.arange(55)) + again, {'exclude_places': 25})


def int8() -> Drive:
    return replace(robust(), settings={'precision': 'int8'})


def two_sessions() -> Drive:
    day, night = map_of(views(range(60))), map_of(views(range(60), gain=0.4, noise=60, seed=5))
    same_as = np.tile(np.arange(60, dtype=np.int32), 2)
    places = replace(merge_maps([day, night], ['day', 'night']), same_as=same_as)
    return Drive(places, dusk(np.linspace(2, 55, IMAGES)))


def both_directions() -> Drive:
    there = np.arange(60)
    return Drive(route_map(), dusk([*there, *there[:19:-1]]), {'direction': 'both'})


def closed_route() -> Drive:
    same_as = np.append(np.arange(60), np.arange(12)).astype(np.int32)
    places = replace(map_of(views(same_as)), same_as=same_as)
    return Drive(places, dusk(np.arange(20, 120) % 60))


def at_rest() -> Drive:
    return Drive(route_map(), dusk([*range(35), *[34] * 30, *range(35, 70)]))


def dark_stretch() -> Drive:
    images = dusk(np.arange(IMAGES))
    images[45:65] = views(np.arange(20), gain=0.02, noise=1)
    return Drive(route_map(), images)


def early() -> Drive:
    """Return a detour, and back at a later place."""
    images = dusk([*range(35), *[0] * 30, *range(70, 105)])
    images[35:65] = dusk(np.arange(30), wall=7)
    return Drive(route_map(), images)


def odometry() -> Drive:
    """Return a drive that jumps back, along odometry that does not."""
    x = 2 + 1.2 * np.arange(IMAGES)
    images = dusk(np.minimum(x, PLACES))
    images[60:] = dusk(np.arange(40) + 20)
    return Drive(route_map(True), images, {}, poses_at(x))


def geometric_check() -> Drive:
    images = dusk(np.arange(IMAGES), noise=12, gain=0.9)
    images[50:70] = dusk(np.arange(20), wall=7)
    return Drive(route_map(), images, {'geometric': GeometricSettings(min_inliers=20)})


def kidnapped() -> Drive:
    return Drive(route_map(), dusk([*range(20, 70), *range(5, 55)]))


def windows_of_12() -> Drive:
    settings = {'sequence': SequenceSettings(12), 'max_error': 0.01}
    return Drive(route_map(), dusk(np.arange(IMAGES), noise=30), settings)


MAKERS: tuple[Callable[[], Drive], ...] = (
    *(robust, paper, loop_closure, late, int8, two_sessions, both_directions, closed_route),
    *(at_rest, dark_stretch, early, odometry, geometric_check, kidnapped, windows_of_12),
)
DRIVES = {make.__name__: make for make in MAKERS}


def many_places(precision: str, mode: str) -> list[Match]:
    """Return the matches on a map of many places, which take several threads and blocks."""
    settings, shape = FeatureSettings('synthetic', None), (7, 6_000, 24)
    rng = np.random.default_rng(0)
    strips = sum(rng.standard_normal(shape, np.float32)[:, i : 5_000 + i] for i in range(4))
    drive = strips[:, 4_000:4_060] + rng.standard_normal((7, 60, 24), np.float32)

    def features(strips: np.ndarray) -> LocalFeatures:
        strips = strips / np.linalg.norm(strips, axis=2, keepdims=True)
        return LocalFeatures(strips, np.full(strips.shape[:2], 7**-0.5, np.float32), settings)

    limit = {'threshold': 0.5} if mode == 'paper' else {}
    recognizer = PlaceRecognizer(
        descriptor_map(features(strips)), RecognizerSettings(mode=mode, **limit), 'cpu', precision
    )
    return [recognizer.update(features(drive[:, i : i + 1])) for i in range(60)]


def plain(value: Any) -> Any:
    """Return all fields, nested, as JSON has them, every bit of every number."""
    if isinstance(value, enum.Enum):
        return value.name
    if is_dataclass(value):
        skipped = {'image', 'stages'}  # pixels that were given, and times
        rows = [(row.name, getattr(value, row.name)) for row in fields(value)]
        return {name: plain(part) for name, part in rows if name not in skipped}
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.tolist()]
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, tuple) and hasattr(value, '_fields'):
        return {name: plain(getattr(value, name)) for name in value._fields}
    if hasattr(value, '__iter__') and not isinstance(value, str | dict):
        return [plain(part) for part in value]
    return value


def answers(drive: Drive) -> Iterator[Any]:
    """Yield every result of a drive and, where the messages are built, its message."""
    pipeline = drive.pipeline()
    for i, result in enumerate(drive.process(pipeline)):
        message = None
        if importlib.util.find_spec('stavpr_msgs'):
            from stavpr_ros.ros.messages import match_message, Outcome, time_message
            from std_msgs.msg import Header

            header = Header(stamp=time_message((i + 1) * SECOND))
            message = match_message(Outcome(header, result, pipeline.operation.matched_places))
        yield plain((result, message))


def row_of(result: ImageResult) -> list[Any]:
    """Return what must not change: status, kind of reason, places, direction, probability."""
    match = result.match
    value = match.distance if math.isnan(match.probability) else match.probability
    return [
        match.status.name,
        re.sub(r'[-+\d.e]*\d[-+\d.e]*', '#', match.reason)[:40],
        match.place,
        match.newest,
        match.path.first,
        match.path.last,
        match.path.direction,
        result.image_index,
        match.inliers >= 20,
        None if math.isnan(value) else round(value, 5),
        [[late.place, round(late.probability, 5)] for late in match.late],
    ]


def rows_of(results: list[ImageResult]) -> list[list[Any]]:
    return [row_of(result) for result in results]


def _margin(rows: list[list[Any]]) -> float:
    """Return how near a probability comes to the default limit."""
    return min((abs(row[9] - 0.5) for row in rows if row[9] is not None), default=math.inf)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--all', type=Path, metavar='FILE', help='write every bit here')
    options = parser.parse_args()
    if options.all:
        document = {name: list(answers(make())) for name, make in DRIVES.items()}
        for precision in ('float32', 'int8'):
            for mode in ('robust', 'paper'):
                document[f'5,000 places, {mode}, {precision}'] = [
                    plain(match) for match in many_places(precision, mode)
                ]
        options.all.write_text(json.dumps(document))
        return
    lines = []
    for name, make in DRIVES.items():
        drive = make()
        rows = rows_of(drive.process(drive.pipeline()))
        counts = {status: sum(row[0] == status for row in rows) for status, *_ in rows}
        print(f'{name}: {counts}, {_margin(rows):.4f} from the limit')
        lines.append(f'{json.dumps(name)}: [\n' + ',\n'.join(map(json.dumps, rows)) + '\n]')
    FILE.write_text('{\n' + ',\n'.join(lines) + '\n}\n')


if __name__ == '__main__':
    main()
