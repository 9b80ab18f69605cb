# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a drive was given before, by the images alone: under another name, or encoded again.

An image is hashed by the signs of random projections of its strips (Charikar, "Similarity
Estimation Techniques from Rounding Algorithms", STOC 2002). Of 256 bits, images that were encoded
as JPEG again, or halved, differ by 2 to 18 from the first ones (medians), the images of another
drive in the same light by 37 or more from the nearest one (least of 7 drives).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.units import DATED

PROBES = 64  # images of a drive that are kept, from its first to its last one
BITS = 256
NEAR = 26  # bits by which two hashes of one image differ at most
SHARE = 0.8  # of the probes, and of the drive from the first to the last of them


@dataclass(frozen=True)
class DriveHash:
    """
    What a drive is recognized by when it is given again.

    :param name: of the drive.
    :param start: stamp of its first image, nanoseconds; 0 = unknown.
    :param hashes: of its probes, one after the other, hexadecimal.
    """

    name: str
    start: int
    hashes: str


def drive_hash(name: str, drive: PlaceMap, images: np.ndarray | None = None) -> DriveHash:
    """Return the hash of a drive, or of these images of it, ascending."""
    images = np.arange(len(drive)) if images is None else images
    probes = images[np.linspace(0, len(images) - 1, min(PROBES, len(images))).astype(int)]
    hashes = _hashes(drive.features[probes]).tobytes().hex()
    return DriveHash(name, int(drive.stamps[images[0]]), hashes)


def session_hashes(place_map: PlaceMap, name: str) -> list[DriveHash]:
    """Return the hash of each session of a map; name: of a map without sessions."""
    index = place_map.session_index
    if index is None:
        return [drive_hash(name, place_map)]
    return [
        drive_hash(session.name or session.id, place_map, np.flatnonzero(index == number))
        for number, session in enumerate(place_map.sessions)
    ]


def earlier_drive(drive: PlaceMap, earlier: Iterable[DriveHash]) -> DriveHash | None:
    """
    Return the drive that this one repeats image by image; None = it is another one.

    A drive of another time by the same clock is another one, however alike its images are.
    """
    n, start, end = len(drive), int(drive.stamps.min()), int(drive.stamps.max())
    hashes = np.concatenate([_hashes(drive.features[i : i + 1024]) for i in range(0, n, 1024)])
    for one in earlier:
        has_one_clock = start and one.start and (start >= DATED) == (one.start >= DATED)
        if has_one_clock and not start <= one.start <= end:
            continue
        probes = np.frombuffer(bytes.fromhex(one.hashes), np.uint8).reshape(-1, hashes.shape[1])
        images = np.flatnonzero(_are_near(hashes, probes))
        if _are_near(probes, hashes).mean() >= SHARE and np.ptp(images) + 1 >= SHARE * n:
            return one
    return None


def _are_near(hashes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return whether each hash is near one of the others, bool."""
    bits, _ = cv2.batchDistance(hashes, others, cv2.CV_32S, K=1, normType=cv2.NORM_HAMMING)
    return bits[:, 0] <= NEAR


def _hashes(features: LocalFeatures) -> np.ndarray:
    """Return the bits of each image, BITS or a few less, packed, (n, bytes), uint8."""
    W, n, d = features.strips.shape
    planes = np.random.default_rng(0).standard_normal((d, max(BITS // W, 1)), np.float32)
    centered = features.strips - features.strips.mean(axis=2, keepdims=True)
    return np.packbits((centered @ planes > 0).transpose(1, 0, 2).reshape(n, -1), axis=1)
