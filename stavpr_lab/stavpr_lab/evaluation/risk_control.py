# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Rates of wrong matches of a recorded query on a map, for conformal risk control.

A unit is a block of successive recorded images: neighboring images are correlated, and so are the
drives that are made of the same images. The risk of a block is the share of wrong ones among its
matches in all these drives; where none of its images has a right place, the share of matched
images. Conformal risk control requires that it never rises with the probability above which images
are matched: the largest one from a probability on is taken.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from stavpr_lab.evaluation.drive import Drive, DriveChanges
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import ImageMatches
from stavpr_ros.mapping.place_map import ErrorRisks

KINDS = ('same', '0.5x', '2x', 'varying')  # drives of the whole map
DETOURS = 3  # drives, each without every third stretch of the map, of as many places as a block
# above which images are matched, evenly spaced by the logarithm of their odds
PROBABILITIES = np.round(1 / (1 + np.exp(-np.linspace(-1, 7, 65))), 4)


def make_drives(truth: GroundTruth, block: int) -> Iterator[Drive]:
    """
    Yield the drives that are made of a recorded query.

    :param truth: ground truth of the recorded images, in places of the whole map.
    :param block: images of a block.
    """
    for name in KINDS:
        yield DriveChanges.from_name(name, truth.N).apply(truth)
    for number in range(min(DETOURS, truth.n // block) if truth.n > block else 0):
        firsts = range(number * block, truth.n, DETOURS * block)
        removed = tuple((first, min(first + block, truth.n)) for first in firsts)
        yield DriveChanges(removed=removed).apply(truth)


def measure_risks(
    outcomes: Iterable[tuple[Drive, ImageMatches, np.ndarray]], block: int, method: str
) -> ErrorRisks:
    """
    Return the risks of the blocks of a recorded query.

    Images beside a removed stretch, which may be matched with its edge, do not count.

    :param driven: drives of it, the first one as recorded, their matches, and the images of
        these: :func:`stavpr_lab.evaluation.metrics.published_matches`.
    :param block: images of a block; the last one also has the rest.
    :param method: key, see :class:`stavpr_ros.mapping.place_map.ErrorRisks`.
    """
    outcomes = list(outcomes)
    units = max(1, len(outcomes[0][0].images) // block)
    wrong, matched, images = np.zeros((3, units, len(PROBABILITIES)))
    on_map = np.zeros((units, 1), bool)
    for drive, matches, at in outcomes:
        truth, recorded = drive.truth.select(at), drive.recorded.has_match[at]
        has_match, correct = truth.has_match, truth.accepts(matches.places)
        unseen = [stretch[at] for stretch in drive.unseen()]
        counted = np.any([has_match | ~recorded, *unseen], axis=0)
        counted &= truth.is_stated
        above = (matches.probabilities[:, None] > PROBABILITIES) & counted[:, None]
        unit = np.minimum(drive.images[at] // block, units - 1)
        np.add.at(matched, unit, above)
        np.add.at(wrong, unit, above & ~correct[:, None])
        np.add.at(images, unit, counted[:, None])
        on_map[unit[has_match]] = True
    rates = wrong / np.maximum(np.where(on_map, matched, images), 1)
    risks = np.maximum.accumulate(rates[:, ::-1], axis=1)[:, ::-1].sum(axis=0)
    return ErrorRisks(method, units, tuple(PROBABILITIES.tolist()), tuple(risks.round(6).tolist()))


def add_risks(one: ErrorRisks, other: ErrorRisks) -> ErrorRisks:
    """Return the risks of the blocks of two queries, at the probabilities of the first one."""
    at = np.searchsorted(other.probabilities, one.probabilities, 'right')
    # below the least probability of the other one, each of its blocks may be wrong
    risks = np.array(one.risks) + np.array([other.units, *other.risks])[at]
    both = one.units + other.units
    sums = tuple(risks.round(6).tolist())
    return ErrorRisks(one.method, both, one.probabilities, sums, other.recordings + one.recordings)
