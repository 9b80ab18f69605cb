# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Time of matching an image, by methods of one image and of sequences, and how many are right.

``python benchmarks/peer_cost.py``: processor time of one thread; features ``gradient``, small
images of SeqSLAM and descriptors of ORB have a column of their own, and the network of ``hybrid``
alone a row. ``right`` is the share of the images of Gardens Point, right side by day on the left
side, whose nearest place is at most two away.
"""

from collections.abc import Callable
from functools import partial
from itertools import count, cycle
import sys
import time
from typing import Any, NamedTuple

from accuracy import identity, short_cases
import cv2
from data import data_folder
import faiss
import numpy as np
from results import environment, options_parser, table, write_json
from stavpr_lab.commands.evaluate_export import image_vectors
from stavpr_lab.evaluation.seqslam import (
    differences,
    enhance_contrast,
    match_differences,
    match_lines,
    preprocess,
    SeqSlamSettings,
)
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import descriptor_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.threads import limit_threads
import timing

SIZES = 2_000, 20_000  # places
WINDOW, TOLERANCE = 20, 2
ORB_FEATURES, ORB_RATIO = 300, 0.8  # Lowe's ratio test
NETWORK = 'efficientnet_lite1'
timed_job = partial(timing.timed_job, clock=time.process_time)


class Drive(NamedTuple):
    """What the methods take of n images: features, small images, and descriptors of ORB."""

    features: LocalFeatures
    small: np.ndarray
    orb: list[np.ndarray]

    @classmethod
    def of_source(cls, source: Any) -> 'Drive':
        """Return the images of a source."""
        images, orb = [frame.image for frame in source], cv2.ORB.create(ORB_FEATURES)
        descriptors = [orb.detectAndCompute(image, None)[1] for image in images]
        assert all(d is not None for d in descriptors)
        features = FeatureExtractor('gradient').extract(images)
        return cls(features, preprocess(images, SeqSlamSettings()), descriptors)

    def repeat(self, n: int, rng: np.random.Generator) -> 'Drive':
        """Return n images: the same ones again and again, with noise."""
        index = np.arange(n) % len(self.features)
        features = self.features[index]
        strips = features.strips
        strips += 0.02 * rng.standard_normal(strips.shape, np.float32)
        strips /= np.linalg.norm(strips, axis=-1, keepdims=True)
        small = self.small[index] + rng.standard_normal((n, self.small.shape[1]), np.float32)
        return Drive(features, small, [self.orb[i] for i in index])


class Method(NamedTuple):
    """
    A method, ready to match the images of a drive.

    :param images: number of images that one match takes.
    :param newest: matches the i-th image, as a robot does it, which has seen those before.
    :param places: returns the places of all images of the drive, (N,).
    """

    images: int
    newest: Callable[[int], Any]
    places: Callable[[], np.ndarray]


def orb_votes(places: Drive, matcher: Any, descriptors: np.ndarray) -> np.ndarray:
    """Return how many descriptors have a distinct nearest one at each place, (n,)."""
    votes = np.zeros(len(places.orb), np.int64)
    for i, of_place in enumerate(places.orb):
        pairs = matcher.knnMatch(descriptors, of_place, 2)
        votes[i] = sum(a.distance < ORB_RATIO * b.distance for a, b in pairs)
    return votes


def methods(places: Drive, query: Drive) -> dict[str, Method]:
    """Return the methods by name."""
    vectors, queries = image_vectors(places.features), image_vectors(query.features)
    index = faiss.IndexFlatIP(vectors.shape[1])
    index.add(vectors)
    matcher, N = cv2.BFMatcher(cv2.NORM_HAMMING), len(query.features)
    settings = SeqSlamSettings(length=WINDOW)
    rows = np.zeros((WINDOW, len(places.features)), np.float32)

    def seqslam(i: int) -> Any:
        D = differences(query.small[i : i + 1], places.small)
        rows[i % WINDOW] = enhance_contrast(D, settings.contrast_window)
        return match_lines(np.roll(rows, -i - 1, axis=0), settings)

    def seqslam_places() -> np.ndarray:
        return match_differences(differences(query.small, places.small), settings)[0]

    def recognizer(mode: str, precision: str) -> Callable[[int], Any]:
        place_map = descriptor_map(places.features)
        settings = RecognizerSettings(mode=mode)
        one = PlaceRecognizer(place_map, settings, precision=precision)
        return lambda i: one.update(query.features[i : i + 1], (i + 1) * 10**8)

    def sequence(mode: str, precision: str) -> Method:
        def all_places() -> np.ndarray:
            newest = recognizer(mode, precision)
            matches = [newest(i) for i in range(N)]
            # of the middle image of each window
            middles = [m.path.place for m in matches]
            return np.array(middles[WINDOW // 2 :] + [-1] * (WINDOW // 2))

        return Method(WINDOW, recognizer(mode, precision), all_places)

    return {
        'NumPy, one product': Method(
            1, lambda i: (vectors @ queries[i]).argmax(), lambda: (queries @ vectors.T).argmax(1)
        ),
        'FAISS flat': Method(
            1,
            lambda i: index.search(queries[i : i + 1], 1),
            lambda: index.search(queries, 1)[1][:, 0],
        ),
        f'ORB, {ORB_FEATURES} a place, brute force': Method(
            1,
            lambda i: orb_votes(places, matcher, query.orb[i]).argmax(),
            lambda: np.array([orb_votes(places, matcher, d).argmax() for d in query.orb]),
        ),
        'SeqSLAM': Method(WINDOW, seqslam, seqslam_places),
        **{
            f'stavpr_ros, mode {mode}, {precision}': sequence(mode, precision)
            for mode in ('paper', 'robust')
            for precision in ('float32', 'int8')
        },
    }


def time_features(images: list[np.ndarray]) -> dict[str, float]:
    """Return the milliseconds that the features of an image take, by the method or the kind."""
    orb, settings, views = cv2.ORB.create(ORB_FEATURES), SeqSlamSettings(), cycle(images)
    gradient, network = (FeatureExtractor(kind) for kind in ('gradient', NETWORK))
    jobs = {
        'ORB': timed_job(lambda: orb.detectAndCompute(next(views), None)),
        'SeqSLAM': timed_job(lambda: preprocess([next(views)], settings)),
        'gradient': timed_job(lambda: gradient.extract([next(views)])),
        NETWORK: timed_job(lambda: network.extract([next(views)])),
    }
    return {kind: 1e3 * times.median_s for kind, times in timing.measure(jobs, 4.0).items()}


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = options_parser(__doc__, f'{SIZES[0]} places').parse_args(arguments)
    limit_threads(1)
    faiss.omp_set_num_threads(1)
    case = next(iter(short_cases(data_folder())))
    places, query = Drive.of_source(case.places), Drive.of_source(case.query)
    N, about = len(query.features), environment(named_commit=options.commit)
    truth, rows = identity(TOLERANCE)(N, len(places.features)), {}
    for name, method in methods(places, query).items():
        matches = method.places()[:, None]
        counted = slice(WINDOW // 2, N - WINDOW // 2)  # in the middle of a window
        right = float(truth.accepts(np.maximum(matches, 0))[counted].mean())
        rows[name] = {'method': name, 'images': method.images, 'right': round(right, 3)}
    features = time_features([frame.image for frame in case.query])
    for name, row in rows.items():
        own = next((kind for kind in features if name.startswith(kind)), 'gradient')
        row['ms_features'] = round(features[own], 3)
    rows[NETWORK] = {'method': NETWORK, 'images': 1, 'ms_features': round(features[NETWORK], 3)}
    for n in SIZES[:1] if options.quick else SIZES:
        ready = methods(places.repeat(n, np.random.default_rng(0)), query)
        numbers = {name: count() for name in ready}

        def match(name: str, method: Method, numbers: Any = numbers) -> None:
            method.newest(next(numbers[name]) % N)

        jobs = {name: timed_job(partial(match, name, method)) for name, method in ready.items()}
        slow = {name: job for name, job in jobs.items() if name.startswith('ORB')}
        for name, times in {
            **timing.measure({name: job for name, job in jobs.items() if name not in slow}, 8.0),
            **timing.measure(slow, 1.0),
        }.items():
            rows[name][f'ms_{n}'] = round(1e3 * times.median_s, 3)
        print(f'{n} places done', flush=True)
    texts = {'images': 'images', 'ms_features': 'ms, features'}
    texts |= {f'ms_{n}': f'ms, {n:,} places' for n in SIZES if f'ms_{n}' in rows['SeqSLAM']}
    texts['right'] = 'right'
    head = ['method', *texts.values()]
    cells = [
        [name, *(f'{row[key]:.3g}' if key in row else '' for key in texts)]
        for name, row in rows.items()
    ]
    print('\n'.join(table(head, cells)))
    write_json(options.output / 'peer_cost.json', about | {'rows': list(rows.values())})
    return 0


if __name__ == '__main__':
    sys.exit(main())
