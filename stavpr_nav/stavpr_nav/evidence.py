# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Evidence that the robot moves as it is commanded: images that change, matches of new places.

A camera that repeats an image and wheels that are blocked look alike: matches keep their place, or
alternate between neighbors. Only a match of a place that was not matched before is evidence.
Meters of the path include turns: a radian counts as ``ARM`` meters, where this is more.
"""

from collections import deque
import math
from typing import Any

import cv2
import numpy as np
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.trajectory import distance, normalize_pose, rotation

MIN_DISTANCE = 0.3  # meters after which evidence is demanded, where the places are dense
ARM = 0.5  # meters
BRIDGE_TIME = 6.0  # seconds of the taught run without a match, of images that change
SLIP = 1.2  # meters that are commanded per meter to the next place, of wheels that slip
MIN_JITTER, MAX_JITTER = 0.5, 1.5  # meters, of matches against the commanded ones, that count
MEMORY = 10  # latest new places whose jitter counts
PERIODS = 1.25  # periods of the images, after this distance or the next place
CELLS = (16, 12)  # columns and rows of the gray levels that are compared
EQUAL_QUANTILE, EQUAL = 0.75, 0.012  # quantile of the cells' changes; its limit, over the contrast
IMAGES = 5  # latest different images: a driver may repeat a ring of its buffers
STILL_DISTANCE = 0.2  # meters that are commanded while odometry stays within MIN_MOTION
MIN_MOTION = 0.02  # meters
MAX_STEP = 0.5  # seconds between two messages or commands; beyond it program or clock has jumped


def path_speed(speed: Any, turn: Any) -> Any:
    """Return meters of the path per second, of m/s and rad/s; numbers or arrays."""
    return np.maximum(abs(speed), ARM * abs(turn))


class ImageComparison:
    """Separates new images from repetitions, up to noise, compression, or a clock in them."""

    def __init__(self) -> None:
        self._images: deque[np.ndarray] = deque(maxlen=IMAGES)

    def is_new(self, image: np.ndarray) -> bool:
        """
        Return whether an image differs from each of the latest new ones.

        :param image: RGB, shape (h, w, 3), uint8.
        """
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        cells = cv2.resize(gray, CELLS, interpolation=cv2.INTER_AREA)
        limit = EQUAL * float(cells.std())
        for earlier in reversed(self._images):
            change = cells - earlier
            if np.quantile(abs(change - np.median(change)), EQUAL_QUANTILE) <= limit:
                return False
        self._images.append(cells)
        return True


class MotionEvidence:
    """
    Decides whether matches show the motion that is commanded.

    :param meters: from the first place to each, shape (n,).
    :param seam: the place that the last one of a closed route shows; None = the route is open.
    :param max_period: seconds, the largest period of images that counts.

    ``is_missing`` stays until :meth:`restart`; ``is_fresh``: there was evidence since the last
    standstill; ``bridge``: seconds of the taught run that the images permit without evidence;
    ``is_changed``: there was a new image since the last evidence.
    """

    def __init__(self, meters: np.ndarray, seam: int | None, max_period: float) -> None:
        self._meters, self._max_period = meters, max_period
        self._lap = math.inf if seam is None else float(meters[-1] - meters[seam])
        self._stamp, self._period = -math.inf, max_period  # of compared images
        self.restart(np.zeros(3))

    def restart(self, totals: np.ndarray, place: int = -1) -> None:
        """
        Begin anew at a standstill.

        :param totals: see :meth:`take`.
        :param place: where the robot is; -1 = unknown, at the first match.
        """
        self.is_missing = False
        self.rest(totals)
        self._matched, self._place = np.zeros(len(self._meters), bool), -1
        self._totals, self._changed = totals, totals[0]
        self.bridge, self.is_changed = 0.0, True
        # lead of the latest new places over the commanded meters, up to a constant
        self._ahead: deque[float] = deque([0.0], MEMORY)
        if place >= 0:
            self._mark(place, totals)

    def rest(self, totals: np.ndarray) -> None:
        """Count a standstill: what an image shows that was taken before is no evidence since."""
        self.is_fresh, self._rested = False, totals[0]

    def take(self, image: Observation, totals: np.ndarray, speed: float) -> None:
        """
        Take the result of an image of the route.

        :param totals: meters that were commanded, meters of odometry, and seconds of the taught
            run that were repeated, until the image.
        :param speed: m/s that is commanded.
        """
        if image.is_compared:
            interval = max(image.stamp - self._stamp, self._period / 2)  # images come in bursts
            self._stamp, self._period = image.stamp, min(interval, self._max_period)
        if image.is_new:
            self._changed = totals[0]
        if image.is_matched or totals[0] - self._changed > MIN_DISTANCE:
            self.bridge = 0.0
        elif image.is_new and image.is_compared:
            self.bridge = BRIDGE_TIME
        if image.is_matched and self.is_changed and not self._matched[image.place]:
            self.is_fresh |= self._place >= 0 and totals[0] > self._rested
            self._mark(image.place, totals)
            self._totals, self.is_changed = totals, False
        elif self.is_due(totals, speed):
            self.is_missing = True

    def is_due(self, totals: np.ndarray, speed: float, delay: float = 0.0) -> bool:
        """
        Return whether there should have been evidence; totals, speed: see :meth:`take`.

        :param delay: seconds until an image is processed.
        """
        since = totals - self._totals
        seconds = PERIODS * self._period + delay
        # matches that were ahead stay at a place until the robot is there
        jitter = min(max(max(self._ahead) - min(self._ahead) - MIN_JITTER, 0.0), MAX_JITTER)
        limit = max(MIN_DISTANCE, SLIP * self._next()) + abs(speed) * seconds + jitter
        return bool(since[:2].max() > limit and since[2] > self.bridge)

    def _mark(self, place: int, totals: np.ndarray) -> None:
        """Mark a place as matched, and unmark the places of the far half of a lap."""
        if self._place >= 0:
            step = math.remainder(self._meters[place] - self._meters[self._place], self._lap)
            self._ahead.append(self._ahead[-1] + step - (totals[0] - self._totals[0]))
        self._place = place
        away = abs(self._meters - self._meters[place])
        around = away % self._lap
        self._matched &= np.minimum(around, self._lap - around) < self._lap / 4
        self._matched |= away < MIN_MOTION

    def _next(self) -> float:
        """Return the meters to the next place that was not matched; 0 at the end of the route."""
        if self._place < 0:
            return 0.0
        away = (self._meters - self._meters[self._place]) % self._lap  # of an open route, or inf
        ahead = float(away[~self._matched & (away > 0)].min(initial=math.inf))
        return ahead if math.isfinite(ahead) else 0.0


class OdometryComparison:
    """
    The motion of the wheels, by the poses of odometry.

    :param max_speed: m/s; steps of twice as much in ``MAX_STEP`` are jumps.

    ``received``: when the latest valid pose came; ``meters`` since :meth:`take_meters`;
    ``commanded``: meters that were commanded until the robot moved last.
    """

    def __init__(self, max_speed: float) -> None:
        self._max_speed = max_speed
        self._last: tuple[str, float, np.ndarray] | None = None
        self._from = np.zeros(7)
        self.meters, self.received, self.commanded = 0.0, -math.inf, 0.0
        self._compared = self.received

    def take(self, frame: str, stamp: float, pose: np.ndarray, now: float) -> None:
        """
        Take a pose.

        :param pose: x y z (meters) and quaternion x y z w, shape (7,).
        :raises InputError: it is not valid, or no motion from the one before; it does not count.
        """
        last, self._last = self._last, (frame, stamp, pose := normalize_pose(pose))
        if last is None:
            self._from = pose
            return
        seconds, step = stamp - last[1], _length(last[2], pose)
        is_motion = step <= 2 * self._max_speed * MAX_STEP
        if last[0] != frame or not 0 < seconds <= MAX_STEP or not is_motion:
            self._from = pose
            raise InputError(
                f'{step:.2f} m and {seconds:.3f} s from frame {last[0]!r} to {frame!r}: expected '
                f'one frame, up to {MAX_STEP:g} s, and {self._max_speed:g} m/s'
            )
        self.meters, self.received = self.meters + step, now

    def take_meters(self) -> float:
        """Return the meters since the last call."""
        meters, self.meters = self.meters, 0.0
        return meters

    def is_still(self, commanded: float) -> bool:
        """
        Return whether a new pose shows that the robot stays while a speed is commanded.

        :param commanded: meters until now.
        """
        is_later, self._compared = self._compared != self.received, self.received
        if is_later and self._last and _length(self._from, self._last[2]) >= MIN_MOTION:
            self._from, self.commanded = self._last[2], commanded
        return is_later and commanded - self.commanded > STILL_DISTANCE


def _length(a: np.ndarray, b: np.ndarray) -> float:
    """Return the meters of the path between two poses."""
    return max(distance(a, b), ARM * math.radians(rotation(a, b)))
