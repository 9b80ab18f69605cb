# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Findings on faults of the setup that leave the node running but recognizing nothing."""

from stavpr_ros.pipeline import PipelineSettings
from stavpr_ros.pipeline.statistics import ImageCounts

BLANK = 3.0
"""
Standard deviation of an image [of 255] below which it shows nothing. The darkest tunnels of
Nordland have 3; of the other data sets no image is below 22.
"""

HOPELESS = 5
"""Windows' lengths of images without any match, from which on the limit itself is suspect."""


def short_map(places: int, length: int) -> str:
    """Return the finding on a map that is shorter than a window, '' = it is not."""
    if places >= length:
        return ''
    return (
        f'the map has fewer places ({places}) than a window has images (sequence_length {length})'
        ': record a longer map, with smaller keyframe distances, or set a shorter sequence_length'
    )


def blank_images(contrast: float) -> str:
    """
    Return the finding on images that show nothing, '' = they show something.

    :param contrast: standard deviation of the last image, NaN = there was none.
    """
    if not contrast < BLANK:
        return ''
    return (
        f'the images show nothing (standard deviation {contrast:.1f} of 255): check the '
        'lens cap, the exposure and the driver, look at them with rqt_image_view'
    )


def never_matched(counts: ImageCounts, settings: PipelineSettings) -> str:
    """Return the finding on a limit that no window has met yet, '' = one has, or it is early."""
    tried = counts.statuses.get('no match', 0)
    if counts.statuses.get('match', 0) or tried < HOPELESS * settings.sequence.length:
        return ''
    never = f'none of {tried} images was ever matched'
    limit = settings.applied_threshold
    if limit is not None and counts.nearest < limit:
        return f'{never}: the geometric check rejects all, lower min_inliers or set it to none'
    if settings.mode == 'robust':
        best = f'probability {1 - counts.nearest:.3f}'
        remedy = f'lower min_probability ({settings.min_probability:g})'
    else:
        best, remedy = f'distance {counts.nearest:.3f}', f'raise threshold ({limit:g})'
    return (
        f'{never}, the best had {best}: compare the route, the direction and the keyframe rules '
        f'with those of the map, or {remedy}'
    )
