# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: the images of a traverse that become places, by time, motion and image change."""

from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.checks import require_at_least, require_between, rgb_image
from stavpr_ros.compilation import kernel
from stavpr_ros.features.area import BLUE, GREEN, HALF, RED
from stavpr_ros.mapping.trajectory import distance, normalize_pose, rotation
from stavpr_ros.units import SECOND

OUT_OF_ORDER = SECOND // 10  # images later than this after a newer one: the clock jumped back
SIZE = (32, 24)  # width and height of the images compared: averages noise out, but not motion
MAX_ROWS = 257  # rows of a block, whose sums of bytes have 16 bits
BLUR = cv2.getGaussianKernel(5, 0.5, cv2.CV_32F).ravel()  # by .5 pixels of the small image
FLAT = 1.0  # standard deviation, gray levels, below which an image shows only noise


@dataclass(frozen=True)
class KeyframeSettings:
    """
    Minimum differences between an image and the last keyframe; 0 = that rule is off.

    All rules in use must be met; distance and angle are one rule, met by either.

    :param interval: time between the two, seconds.
    :param distance: between their poses, meters.
    :param angle: between their poses, degrees, up to 180.
    :param change: :func:`image_change` of the two, up to 2.
    :raises SettingsError: a number that is negative, not finite or too large.
    """

    interval: float = 0.0
    distance: float = 0.0
    angle: float = 0.0
    change: float = 0.0

    def __post_init__(self) -> None:
        require_at_least('keyframe interval', self.interval, 0, 'seconds')
        require_at_least('keyframe distance', self.distance, 0, 'meters')
        require_between('keyframe angle', self.angle, 0, 180, 'degrees')
        require_between('keyframe change', self.change, 0, 2)

    @property
    def any(self) -> bool:
        """Return whether any rule is on: not every image is a keyframe."""
        return bool(self.interval or self.needs_poses or self.change)

    @property
    def needs_poses(self) -> bool:
        """Return whether the rule of motion is on."""
        return bool(self.distance or self.angle)


def small_gray(image: np.ndarray) -> np.ndarray:
    """
    Return the small, blurred, gray version of an image for comparisons.

    :param image: RGB, uint8, shape (h, w, 3).
    :returns: float32, shape (24, 32).
    :raises InputError: another image.
    """
    image = rgb_image(image)
    width, height = SIZE
    is_whole = not (image.shape[0] % height or image.shape[1] % width)
    if not is_whole or image.shape[0] > MAX_ROWS * height:
        small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    else:
        small = np.empty((height, width, 3), np.uint8)
        _block_means(image.reshape(height, -1, image.shape[1] * 3), small)
    return np.asarray(_blur(small))


@kernel
def _block_means(rows: np.ndarray, small: np.ndarray) -> None:
    """
    Write the means of blocks of pixels, rounded as OpenCV's: its sums are of whole numbers, too.

    :param rows: pixels of each row of blocks, shape (h, rows, 3 columns), uint8.
    :param small: shape (h, w, 3), uint8, written.
    """
    height, count, length = rows.shape
    side = length // (3 * small.shape[1])  # pixels
    scale, sums = np.float32(1) / np.float32(count * side), np.empty(length, np.uint16)
    for i in range(height):
        sums[:] = 0
        for row in range(count):
            for x in range(length):
                sums[x] += np.uint16(rows[i, row, x])
        for j in range(small.shape[1]):
            for channel in range(3):
                total = np.uint32(0)
                for x in range(3 * j * side + channel, 3 * (j + 1) * side, 3):
                    total += sums[x]
                small[i, j, channel] = np.uint8(np.rint(np.float32(total) * scale))


@kernel
def _blur(small: np.ndarray) -> np.ndarray:
    """Return an RGB image (h, w, 3) in OpenCV's gray levels, blurred, mirrored at its edges."""
    height, width, reach = small.shape[0], small.shape[1], len(BLUR) // 2
    bottom, right = height - 1, width - 1
    levels = np.empty((height + 2 * reach, width + 2 * reach))
    for y in range(levels.shape[0]):
        for x in range(levels.shape[1]):
            row = small[bottom - abs(bottom - abs(y - reach))]
            pixel = row[right - abs(right - abs(x - reach))]
            levels[y, x] = (pixel[0] * RED + pixel[1] * GREEN + pixel[2] * BLUE + HALF) >> 15
    gray = np.zeros((height, width), np.float32)
    for i in range(len(BLUR)):
        for y in range(height):
            for j in range(len(BLUR)):
                for x in range(width):
                    gray[y, x] += BLUR[i] * BLUR[j] * levels[y + i, x + j]
    return gray


@kernel
def image_change(a: np.ndarray, b: np.ndarray) -> float:
    """
    Return 1 - the normalized cross-correlation, invariant to brightness and gain.

    :param a: result of :func:`small_gray`, shape (24, 32), float32; so is b.
    :returns: 0 (equal) to 2 (negatives of each other); two flat images 0, one flat image 1.
    """
    sum_a = sum_b = aa = bb = ab = 0.0
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            sum_a, sum_b = sum_a + a[y, x], sum_b + b[y, x]
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            of_a, of_b = a[y, x] - sum_a / a.size, b[y, x] - sum_b / b.size
            aa, bb, ab = aa + of_a * of_a, bb + of_b * of_b, ab + of_a * of_b
    min_energy = FLAT**2 * a.size
    if aa < min_energy or bb < min_energy:
        return 0.0 if aa < min_energy and bb < min_energy else 1.0
    return min(max(1 - ab / np.sqrt(aa * bb), 0.0), 2.0)


class KeyframeSelector:
    """
    Selector of the images that become keyframes.

    Call :meth:`too_soon` first, which needs no image, then :meth:`too_alike`; if both return no
    reason, :meth:`accept`. The first image is a keyframe, unless the rule of motion has no pose.

    :param settings: the rules; may be replaced at any time, the last keyframe is kept.
    """

    def __init__(self, settings: KeyframeSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Discard the last keyframe: the next image is one."""
        self._stamp = 0
        self._pose: np.ndarray | None = None
        self._gray: np.ndarray | None = None  # small and gray, of the last keyframe
        self._compared: tuple[np.ndarray, np.ndarray] | None = None  # an image, and the same of it

    def too_soon(self, stamp: int, pose: np.ndarray | None) -> str:
        """
        Return why an image is no keyframe by the rules of time and motion.

        A rule is met if the stamp or pose of the last keyframe is unknown, or if the stamp is
        0.1 s or more before the last keyframe's: the clock has jumped back.

        :param stamp: nanoseconds; 0 = unknown.
        :param pose: where it was taken, shape (7,), see :class:`Map`; None = unknown.
        :returns: the reason in words; empty if there is none.
        :raises InputError: an invalid pose.
        """
        settings = self.settings
        if settings.needs_poses and pose is None:
            return 'no odometry for this image, and a minimum distance or angle is set'
        if settings.interval and stamp and self._stamp:
            elapsed = stamp - self._stamp
            if -OUT_OF_ORDER < elapsed < round(settings.interval * SECOND):
                return (
                    f'{elapsed / SECOND:.3f} s after the last keyframe: less than '
                    f'{settings.interval:g} s'
                )
        if settings.needs_poses and self._pose is not None and pose is not None:
            return self._motion_reason(normalize_pose(pose), self._pose)
        return ''

    def too_alike(self, image: np.ndarray) -> str:
        """
        Return why an image is no keyframe by the rule of image change.

        :param image: RGB, uint8, shape (h, w, 3).
        :returns: the reason in words; empty if there is none.
        """
        min_change = self.settings.change
        if not min_change or self._gray is None:
            return ''
        self._compared = image, small_gray(image)
        change = image_change(self._compared[1], self._gray)
        if change < min_change:
            return f'differs by {change:.4f} from the last keyframe: less than {min_change:g}'
        return ''

    def accept(self, stamp: int, pose: np.ndarray | None, image: np.ndarray) -> None:
        """
        Make an image the last keyframe: the next ones are compared with it.

        :param stamp: nanoseconds; 0 = unknown.
        :param pose: where it was taken, shape (7,); None = unknown.
        :param image: RGB, uint8, shape (h, w, 3).
        :raises InputError: an invalid pose or image; nothing is changed.
        """
        pose, compared = None if pose is None else normalize_pose(pose), self._compared
        if compared is None or compared[0] is not image:
            compared = image, small_gray(image)
        self._gray, self._compared = compared[1], None
        self._stamp, self._pose = stamp, pose

    def _motion_reason(self, pose: np.ndarray, last: np.ndarray) -> str:
        rules = self.settings
        shift, turn = distance(pose, last), rotation(pose, last)
        far = rules.distance and shift >= rules.distance
        if far or (rules.angle and turn >= rules.angle):
            return ''
        words = []
        if rules.distance:
            words.append(f'moved {shift:.3f} m of {rules.distance:g} m')
        if rules.angle:
            words.append(f'turned {turn:.2f} of {rules.angle:g} degrees')
        return ' and '.join(words) + ' since the last keyframe'
