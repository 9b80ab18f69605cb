# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The heading error of a camera against the mapped pass, by registration of images of one place.

Every column of an image is described by the oriented gradients of its rows above the ground, and
compared with every column of the image of the place. Where u in -1..1 is the position in the image
of the place, the scene is shifted by

    shift(u) = h + a u |u| + b |u|

h is the shift of the distant scene: the camera is turned. b is the parallax of a lateral offset:
the scene beside the path is near. a is an offset along the path. The similarities of the columns
along each such curve are summed; the sums of successive images are added up with a forgetting
factor, so that one peak prevails over peaks of repeating structure. exp of the sum, with a normal
prior of h, a and b, is the posterior.
"""

from dataclasses import dataclass
import math

import cv2
import numpy as np
from stavpr_ros.alignment.cpu.dot import dot_product
from stavpr_ros.checks import float_array, no_nan, rgb_image
from stavpr_ros.compilation import kernel

WIDTH = 192  # pixels of the compared images
GROUND = 0.62  # the rows below this part of the height are not compared
ROWS, ORIENTATIONS = 20, 4
BLOCKS = 16  # blocks of columns
REACH = WIDTH // 2  # largest shift, pixels
SMOOTHING, COLUMN_SMOOTHING, CONTRAST_RADIUS = 1.0, 2.0, 12.0  # pixels, deviations
CONTRAST, CLIP = 0.05, 2.5  # added to the local contrast; largest relative gradient
EVIDENCE = 60.0  # nats for a mean similarity of 1 over the whole image; images are dependent
MIN_OVERLAP = 0.4  # part of the blocks
FORGETTING = 0.8  # factor on the sum of the earlier images
DRIFT, STEP = 3.0, 6  # pixels that the shift changes between two images, deviation and maximum
JUMP = 8.0  # nats: the most that the earlier images say against a shift, a camera may turn at once
PEAK = 5  # pixels from the most probable shift that are one peak
MIN_RATIO = 9.0  # probability of a valid offset's peak over the second peak's
MIN_SIMILARITY = 0.12  # similarity of a valid offset
DISTANT = 0.3  # parallax of the distant scene, which is not infinitely far, over `parallax`
# Pixels of a sharp peak; errors of neighboring columns are dependent.
FLOOR, INFLATION = 0.5, 2.0
FLOOR_B = 0.007  # deviation of the parallax by a step of B
# Deviations of the prior: h in widths; a and b in half widths.
PRIOR_H, PRIOR_A, PRIOR_B = 0.25, 0.08, 0.15
A, B = (axis.ravel() for axis in np.meshgrid(
    np.linspace(-0.1, 0.1, 5), np.linspace(-0.3, 0.3, 25), indexing='ij'
))  # fmt: skip
PARTS = 4  # shifts of a block are in parts of a pixel: a small parallax is less than a pixel
SHIFTS = np.arange(-REACH, REACH + 1)
BLOCK_CENTERS = ((np.arange(BLOCKS) + 0.5) / BLOCKS - 0.5) * 2


@dataclass(frozen=True)
class Offset:
    """
    How an image is turned and offset against the image of a place.

    :param shift: h as a part of the width of the image, positive: the distant scene is further to
        the right, the camera is turned to the left (REP-103).
    :param deviation: standard deviation of the shift.
    :param parallax: b / 2, how much further the scene is shifted at both sides of the image, as a
        part of the width, positive: the camera is to the left of the path.
    :param ratio: probability of the peak over the second peak's.
    :param similarity: mean similarity of the columns of this image alone at the peak; about 0 for
        a covered camera, or for images of other places.
    :param parallax_deviation: NaN = unknown.
    """

    shift: float
    deviation: float
    parallax: float
    ratio: float
    similarity: float
    parallax_deviation: float = math.nan

    @property
    def is_similar(self) -> bool:
        """Return whether the image is similar to the image of the place."""
        return self.similarity >= MIN_SIMILARITY

    @property
    def is_valid(self) -> bool:
        """Return whether the images determine the shift."""
        return self.is_similar and self.ratio >= MIN_RATIO

    def heading(self, focal: float) -> float:
        """
        Return the heading error of the camera, radians to the left: the shift without parallax.

        :param focal: focal length, as a part of the width of the image.
        """
        return math.atan((self.shift - DISTANT * self.parallax) / focal)


def describe_columns(image: np.ndarray) -> np.ndarray:
    """
    Describe the columns of an image.

    :param image: RGB, shape (h, w, 3), uint8.
    :returns: unit vectors, shape (WIDTH, ROWS * ORIENTATIONS), float32.
    """
    image = rgb_image(image)
    height = max(ROWS, round(WIDTH * image.shape[0] / image.shape[1] * GROUND))
    above = cv2.cvtColor(image[: max(1, round(image.shape[0] * GROUND))], cv2.COLOR_RGB2GRAY)
    gray = cv2.resize(above, (WIDTH, height), interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(np.log1p(32 / 255 * gray.astype(np.float32)), (0, 0), SMOOTHING)
    dx, dy = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    # cos(2 (angle - k pi / ORIENTATIONS)), of gradients without a sign
    square = np.maximum(dx * dx + dy * dy, 1e-12)
    size = np.sqrt(square)
    double = (dx * dx - dy * dy) / size, 2 * dx * dy / size
    angles = 2 * np.pi * np.arange(ORIENTATIONS, dtype=np.float32) / ORIENTATIONS
    parts = np.maximum(
        double[0][..., None] * np.cos(angles) + double[1][..., None] * np.sin(angles), 0
    )
    parts /= np.sqrt(cv2.GaussianBlur(square, (0, 0), CONTRAST_RADIUS))[..., None] + CONTRAST
    parts = cv2.GaussianBlur(
        np.minimum(parts, CLIP), (0, 0), sigmaX=COLUMN_SMOOTHING, sigmaY=height / ROWS / 2
    )
    rows = ((np.arange(ROWS) + 0.5) * height / ROWS).astype(int)
    columns = parts[rows].transpose(1, 0, 2).reshape(WIDTH, -1)
    columns = columns - columns.mean(axis=0)
    norms = np.linalg.norm(columns, axis=1, keepdims=True)
    return columns / np.maximum(norms, 1e-6)


def in_parts(half_widths: np.ndarray) -> np.ndarray:
    """Return shifts beside h, half widths, in parts of a pixel, int64."""
    return np.rint(half_widths * PARTS * WIDTH / 2).astype(np.int64)


class OffsetFilter:
    """Estimates the offset of each image of a sequence."""

    def __init__(self) -> None:
        u = BLOCK_CENTERS
        self._beside = in_parts(A[:, None] * u * abs(u) + B[:, None] * abs(u))
        of_model = (A / PRIOR_A) ** 2 + (B / PRIOR_B) ** 2
        self._prior = -0.5 * (of_model[:, None] + (SHIFTS / (PRIOR_H * WIDTH)) ** 2)
        self.reset()

    def reset(self) -> None:
        """Forget the images."""
        self._earlier = np.zeros_like(self._prior)

    def update(self, query: np.ndarray, place: np.ndarray) -> Offset:
        """
        Return the offset of an image against the image of its place.

        :param query, place: their columns, as :func:`describe_columns` returns them.
        :raises InputError: other arrays; the filter is as before.
        """
        query, place = _columns(query, 'query'), _columns(place, 'place')
        evidence, is_covered = block_evidence(query, place, self._beside)
        self._earlier = FORGETTING * _drift(self._earlier) + evidence
        log = np.where(is_covered, self._earlier + self._prior, -np.inf)
        posterior = np.exp(log - log.max())
        posterior /= posterior.sum()
        by_shift = posterior.sum(axis=0)
        masses = np.convolve(by_shift, np.ones(PEAK), 'same')
        peak = int(np.argmax(masses))
        part = slice(max(0, peak - PEAK), peak + PEAK + 1)
        probability = float(by_shift[part].sum())
        shift = float(by_shift[part] @ SHIFTS[part]) / probability
        variance = float(by_shift[part] @ (SHIFTS[part] - shift) ** 2) / probability
        by_model = posterior[:, part].sum(axis=1) / probability
        parallax = float(by_model @ B) / 2
        variance_b = INFLATION**2 * float(by_model @ (B / 2 - parallax) ** 2)
        deviation = INFLATION * math.sqrt(variance + FLOOR**2)
        second = masses[abs(SHIFTS - SHIFTS[peak]) > 2 * PEAK].max()
        ratio = masses[peak] / max(second, 1e-12)
        similarity = float(evidence[:, part].max()) / EVIDENCE
        return Offset(
            shift / WIDTH, deviation / WIDTH, parallax, float(ratio), similarity,
            math.sqrt(variance_b + FLOOR_B**2),
        )  # fmt: skip


def _columns(columns: np.ndarray, name: str) -> np.ndarray:
    """Return columns as the kernels read them."""
    name = f'{name}, columns as of describe_columns(image)'
    columns = no_nan(float_array(columns, name, f'{WIDTH} {ROWS * ORIENTATIONS}'), name)
    return columns.astype(np.float32, copy=False)


# ------------------------------------------------ kernels


@kernel
def block_evidence(
    query: np.ndarray, place: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the evidence (nats) for each (a, b) and shift, and whether enough blocks overlap.

    The blocks that overlap by h alone count. One that a model moves out of the image is as similar
    as at the border: models are compared by the same blocks, so that no shift counts as parallax.

    :param query, place: their columns, (WIDTH, d), float32.
    :param beside: shift of each block of columns beside h, see :func:`in_parts`, (models, BLOCKS).
    """
    size, shifts, models = WIDTH // BLOCKS, 2 * REACH + 1, len(beside)
    means, is_covered = np.zeros((BLOCKS, shifts)), np.zeros((BLOCKS, shifts), np.bool_)
    for block in range(BLOCKS):
        for k in range(shifts):
            total, count = 0.0, 0
            first = max(block * size, REACH - k)
            last = min((block + 1) * size, WIDTH + REACH - k)
            for x in range(first, last):
                total += dot_product(place[x], query[x + k - REACH])
            if 2 * (last - first) >= size:
                means[block, k], is_covered[block, k] = total / (last - first), True
    parts = np.empty((BLOCKS, PARTS * (shifts - 1) + 1))
    for block in range(BLOCKS):
        covered = np.flatnonzero(is_covered[block])
        first, last = PARTS * covered[0], PARTS * covered[-1]
        parts[block, first : last + 1] = _in_between(means[block, covered])
        parts[block, :first], parts[block, last:] = parts[block, first], parts[block, last]
    evidence, is_enough = np.zeros((models, shifts)), np.zeros((models, shifts), np.bool_)
    for model in range(models):
        for k in range(shifts):
            total, count = 0.0, 0
            for block in range(BLOCKS):
                if is_covered[block, k]:
                    shift = PARTS * k + beside[model, block]
                    total += parts[block, min(max(shift, 0), PARTS * (shifts - 1))]
                    count += 1
            evidence[model, k] = EVIDENCE / BLOCKS * total * np.sqrt(BLOCKS / max(count, 1))
            is_enough[model, k] = count >= MIN_OVERLAP * BLOCKS
    return evidence, is_enough


@kernel
def _in_between(means: np.ndarray) -> np.ndarray:
    """
    Return the means at parts of a pixel, by cubic (Catmull-Rom) interpolation.

    Linear interpolation lowers a peak between two pixels: small shifts would be zero.
    """
    padded = np.empty(len(means) + 2)
    padded[0], padded[-1] = 2 * means[0] - means[1], 2 * means[-1] - means[-2]
    padded[1:-1] = means
    parts = np.full(PARTS * (len(means) - 1) + 1, means[-1])
    for k in range(len(means) - 1):
        p0, p1, p2, p3 = padded[k], padded[k + 1], padded[k + 2], padded[k + 3]
        for part in range(PARTS):
            t = part / PARTS
            slope = p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0))
            parts[PARTS * k + part] = p1 + t / 2 * slope
    return parts


@kernel
def _drift(earlier: np.ndarray) -> np.ndarray:
    """Return the sum of the earlier images where the shift has changed: a parabola, or a jump."""
    result = np.maximum(earlier, earlier.max() - JUMP)
    last = earlier.shape[1] - 1
    for model in range(len(earlier)):
        for k in range(last + 1):
            for by in range(-STEP, STEP + 1):
                value = earlier[model, min(max(k + by, 0), last)] - 0.5 * (by / DRIFT) ** 2
                result[model, k] = max(result[model, k], value)
    return result
