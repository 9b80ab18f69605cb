# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The stages before the matching: decoding of a message, extraction of gradient features."""

from functools import partial
from itertools import cycle
from types import SimpleNamespace
from typing import Any

import cv2
from lower_bounds import Work
import numpy as np
from run import Peer, Run
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.extractor import cut_strips, normalize
from stavpr_ros.features.gradient import feature_maps_by_torch, GradientSettings
from stavpr_ros.mapping import small_gray
from stavpr_ros.sources.encodings import decode_message
from timing import timed
import torch

WIDTH, HEIGHT, BATCH = 640, 480, 16
FULL_HD, FULL_HD_IMAGES = (1080, 1920), 8
IMAGES = 64  # more memory than a cache holds, as a camera's


def make_images(seed: int) -> list[np.ndarray]:
    """Cut images out of a random panorama, RGB uint8."""
    coarse = np.random.default_rng(seed).integers(0, 256, (HEIGHT // 16, 80, 3), np.uint8)
    panorama = cv2.resize(coarse, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(panorama[:, 8 * i : 8 * i + WIDTH]) for i in range(IMAGES)]


def by_torch(images: list[np.ndarray]) -> Any:
    """Extract features with the operators of OpenCV and torch only."""
    s = GradientSettings()
    square = partial(cv2.resize, dsize=(s.size, s.size), interpolation=cv2.INTER_AREA)
    gray = np.stack([square(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images])
    return normalize(cut_strips(feature_maps_by_torch(torch.from_numpy(gray), s), 7))


def extraction_stages(run: Run, seed: int) -> None:
    """Measure decoding, and extraction of one image and of a batch."""
    images, extractor = make_images(seed), FeatureExtractor()
    messages = cycle([
        SimpleNamespace(
            height=HEIGHT, width=WIDTH, encoding='rgb8', is_bigendian=False, step=3 * WIDTH,
            data=image.reshape(-1),
        )
        for image in images
    ])  # fmt: skip
    size = images[0].nbytes
    run.measure('decoding', (1, 0), lambda: decode_message(next(messages)), [Work(size, 0)])

    def measure_batches(n: int) -> None:
        batches = [images[i : i + n] for i in range(0, IMAGES, n)]
        ours, theirs = cycle(batches), cycle(batches)
        job = timed(lambda: by_torch(next(theirs)))
        peer = Peer('torch operators', job, 'the same features, on all cores')
        call, works = (lambda: extractor.extract(next(ours))), [Work(n * size, 0)]
        run.measure('extraction', (n, 0), call, works, [peer])

    measure_batches(1)
    measure_batches(BATCH)
    for kind in ('raw', 'JPEG'):
        full_hd_stage(run, images, extractor, kind)


def full_hd_stage(
    run: Run, images: list[np.ndarray], extractor: FeatureExtractor, kind: str
) -> None:
    """Measure an image of 1920x1080 from the message to its features, beside a whole one."""
    height, width = FULL_HD
    large = [
        cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
        for image in images[:FULL_HD_IMAGES]
    ]
    if kind == 'raw':
        messages = [
            SimpleNamespace(
                height=height, width=width, encoding='rgb8', is_bigendian=False, step=3 * width,
                data=image.reshape(-1),
            )
            for image in large
        ]  # fmt: skip
    else:
        messages = [
            SimpleNamespace(format='jpeg', data=cv2.imencode('.jpg', image)[1]) for image in large
        ]
    size = extractor.settings.backbone.size

    def features(least: tuple[int, int] | None, turn: Any) -> Any:
        image = decode_message(next(turn), least)
        small_gray(image)  # of the keyframes
        return extractor.extract([image])

    ours, theirs = cycle(messages), cycle(messages)
    peer = Peer('whole image', timed(lambda: features(None, theirs)))
    call = partial(features, (size, size), ours)
    run.measure(
        f'1080p {kind} to features', (1, 0), call, [Work(messages[0].data.nbytes, 0)], [peer]
    )
