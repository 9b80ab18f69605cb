# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a drive was given before, image by image: under another name, or encoded again.

Images are compared by the signs of random projections of their strips. Of 256 bits, 2 to 18 differ
after another encoding as JPEG (medians), 37 or more between drives in the same light.
"""

from collections.abc import Iterable

import numpy as np
from stavpr_ros.mapping import Map
from stavpr_ros.units import DATED

PROBES = 64  # images of a drive that are compared, from its first to its last one
BITS, NEAR = 256, 26  # bits of an image; bits that differ at most
SHARE = 0.8  # part of the probes that is near

Row = tuple[str, int, str]
"""Name of a drive, stamp of its first image, ns, 0 = unknown, and the bits, hexadecimal."""


def rows_of(place_map: Map, name: str) -> list[Row]:
    """Return a row for each session of a map; name: of a map without sessions."""
    index, rows = place_map.session_index, []
    index = np.zeros(len(place_map)) if index is None else index
    names = [session.name or session.id for session in place_map.sessions] or [name]
    for number, session_name in enumerate(names):
        images = np.flatnonzero(index == number)
        probes = images[np.linspace(0, len(images) - 1, min(PROBES, len(images))).astype(int)]
        strips = place_map.features[probes].strips.transpose(1, 0, 2)  # (images, W, d)
        planes = np.random.default_rng(0).standard_normal(
            (strips.shape[2], max(BITS // strips.shape[1], 1)), np.float32
        )
        bits = (strips - strips.mean(axis=2, keepdims=True)) @ planes > 0
        text = ' '.join(np.packbits(image_bits).tobytes().hex() for image_bits in bits)
        rows.append((session_name, int(place_map.stamps[images[0]]), text))
    return rows


def earlier_drive(drive: Row, earlier: Iterable[Row]) -> str:
    """Return the name of the drive that this one repeats; '' = none, or one of another time."""
    numbers = [int(word, 16) for word in drive[2].split()]
    for name, start, text in earlier:
        has_one_clock = start and drive[1] and (start >= DATED) == (drive[1] >= DATED)
        others = [int(word, 16) for word in text.split()]
        if len(numbers) == len(others) and not (has_one_clock and start != drive[1]):
            is_near = [(a ^ b).bit_count() <= NEAR for a, b in zip(numbers, others, strict=True)]
            if sum(is_near) >= SHARE * len(is_near):
                return name
    return ''
