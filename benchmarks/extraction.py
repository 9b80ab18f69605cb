# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The stages before the matching: decoding of a message, extraction of gradient features."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle
import math
from types import SimpleNamespace
from typing import Any

import cv2
from lower_bounds import Work
import numpy as np
from run import Peer, Run
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.extractor import cut_strips, normalize
from stavpr_ros.features.gradient import FLOOR
from stavpr_ros.features.registry import GradientSettings
from stavpr_ros.mapping import small_gray
from stavpr_ros.sources.encodings import decode_message
from timing import timed_job
import torch
from torch.nn.functional import avg_pool2d, pad

WIDTH, HEIGHT, BATCH = 640, 480, 16
FULL_HD, FULL_HD_IMAGES = (1920, 1080), 8
IMAGES = 64  # more memory than a cache has, as a camera's


def make_images() -> list[np.ndarray]:
    """Cut images out of a random panorama, RGB uint8."""
    coarse = np.random.default_rng(0).integers(0, 256, (HEIGHT // 16, 80, 3), np.uint8)
    panorama = cv2.resize(coarse, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(panorama[:, 8 * i : 8 * i + WIDTH]) for i in range(IMAGES)]


def by_torch(images: list[np.ndarray]) -> Any:
    """Extract features with the operators of OpenCV and torch only."""
    s = GradientSettings()
    square = partial(cv2.resize, dsize=(s.size, s.size), interpolation=cv2.INTER_AREA)
    gray = np.stack([square(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images])
    return normalize(cut_strips(feature_maps_by_torch(torch.from_numpy(gray), s).numpy(), 7))


def feature_maps_by_torch(gray: torch.Tensor, settings: GradientSettings) -> torch.Tensor:
    """
    Compute the feature maps of square images with torch's operators, on their device.

    :param gray: shape (n, size, size), uint8.
    :returns: shape (n, orientations, cells, cells), float32.
    """
    padded = pad(gray[:, None].float() / 255, (1, 1, 1, 1), mode='replicate')
    dx = padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]
    dy = padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]
    period = 2 * math.pi if settings.signed else math.pi
    bins = settings.orientations
    position = (torch.atan2(dy, dx) * (bins / period)).remainder_(bins)
    centers = torch.arange(bins, dtype=torch.float32, device=gray.device)
    offset = (position - centers[None, :, None, None]).abs_()
    # linear between two bins
    share = torch.clamp_(1 - torch.minimum(offset, bins - offset), min=0)
    cell = settings.cell
    share.mul_(torch.hypot(dx, dy))
    # cells overlap by half; each is multiplied by the mean of 1 / norm of its four blocks
    histograms = avg_pool2d(share, 2 * cell, stride=cell, padding=cell // 2)
    energy = pad((histograms**2).sum(dim=1, keepdim=True), (1, 1, 1, 1), mode='replicate')
    scale = torch.rsqrt(4 * avg_pool2d(energy, 2, stride=1) + FLOOR)
    return histograms * avg_pool2d(scale, 2, stride=1)


def raw_message(image: np.ndarray) -> Any:
    """Return an image as a raw message."""
    height, width, _ = image.shape
    return SimpleNamespace(
        height=height, width=width, encoding='rgb8', is_bigendian=False, step=3 * width,
        data=image.reshape(-1),
    )  # fmt: skip


def extraction_stages(run: Run) -> None:
    """Measure decoding, extraction of one image and of a batch, and both of images of 1080p."""
    images, extractor = make_images(), FeatureExtractor('gradient')
    size, messages = images[0].nbytes, cycle([raw_message(image) for image in images])
    run.measure('decoding', (1, 0), lambda: decode_message(next(messages)), [Work(size, 0)])
    for n in (1, BATCH):
        batches = [images[i : i + n] for i in range(0, IMAGES, n)]
        call = partial(on_next, extractor.extract, cycle(batches))
        job = timed_job(partial(on_next, by_torch, cycle(batches)))
        peer = Peer('torch operators', job, 'the same features, on all cores')
        run.measure('extraction', (n, 0), call, [Work(n * size, 0)], [peer])

    def features(message: Any, min_size: tuple[int, int] | None = None) -> Any:
        image = decode_message(message, min_size)
        small_gray(image)  # of the keyframes
        return extractor.extract([image])

    large = [cv2.resize(image, FULL_HD) for image in images[:FULL_HD_IMAGES]]
    jpeg = [SimpleNamespace(format='jpeg', data=cv2.imencode('.jpg', one)[1]) for one in large]
    side = extractor.settings.backbone.size
    for kind, of_kind in (('raw', [raw_message(image) for image in large]), ('JPEG', jpeg)):
        peer = Peer('whole image', timed_job(partial(on_next, features, cycle(of_kind))))
        call = partial(on_next, partial(features, min_size=(side, side)), cycle(of_kind))
        works = [Work(of_kind[0].data.nbytes, 0)]
        run.measure(f'1080p {kind} to features', (1, 0), call, works, [peer])


def on_next(function: Callable[[Any], Any], values: Iterator[Any]) -> Any:
    """Apply a function to the next value."""
    return function(next(values))
