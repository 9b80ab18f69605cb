# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera of a map: its intrinsics, and where it is on the robot."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import cv2
import numpy as np
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.trajectory import normalize_pose

MODELS = {'plumb_bob': (4, 5), 'rational_polynomial': (8,), 'equidistant': (4,)}
FORWARD = (0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5)
"""Pose in the base (x ahead, z up) of an optical frame (z ahead, y down) that looks ahead."""
ASPECT = 0.02  # largest relative difference of the proportions of image and intrinsics


@dataclass(frozen=True)
class Camera:
    """
    A calibrated camera on a robot.

    :param width, height: size of the images that were calibrated, pixels.
    :param focal: fx and fy, pixels; center: cx and cy.
    :param model: model of the distortion, as in sensor_msgs/CameraInfo; '' = none.
    :param distortion: its coefficients.
    :param mount: pose of the optical frame (z ahead, x right) in the frame whose poses the places
        have, x y z (meters) and quaternion x y z w.
    :raises InputError: not calibrated, an unknown model, or numbers that are not finite.
    """

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    model: str = ''
    distortion: tuple[float, ...] = ()
    mount: tuple[float, ...] = FORWARD

    def __post_init__(self) -> None:
        numbers = (*self.focal, *self.center, *self.distortion)
        if not (min(self.width, self.height) > 0 and min(self.focal) > 0):
            raise InputError(
                f'camera of {self.width}x{self.height} pixels, focal length {self.focal}: '
                'expected numbers above 0; calibrate the camera'
            )
        if not all(map(math.isfinite, numbers)):
            raise InputError(f'intrinsics {numbers} are not finite: calibrate the camera')
        if any(self.distortion) and len(self.distortion) not in MODELS.get(self.model, ()):
            raise InputError(
                f'distortion model {self.model!r} with {len(self.distortion)} coefficients: take '
                f'one of {", ".join(MODELS)}'
            )
        object.__setattr__(self, 'mount', tuple(normalize_pose(np.array(self.mount)).tolist()))

    @property
    def oddity(self) -> str:
        """Return why the intrinsics seem to be of another image or unit, '' = they do not."""
        size, text = (self.width, self.height), f'of {self.width}x{self.height} pixels'
        if not all(0.25 < c / n < 0.75 for c, n in zip(self.center, size, strict=True)):
            x, y = self.center
            fault = f'the center ({x:.0f}, {y:.0f}), as of another resolution or a part'
        elif not all(0.1 < f / n < 50 for f, n in zip(self.focal, size, strict=True)):
            fault = f'the focal length {self.focal[0]:g}, as of another unit'
        else:
            return ''
        return f'camera_info {text} has {fault}: calibrate the camera as it runs'

    def require_fitting(self, width: int, height: int) -> None:
        """Raise InputError if images have other proportions than the intrinsics."""
        if abs(width * self.height / (height * self.width) - 1) > ASPECT + 1 / min(width, height):
            raise InputError(
                f'the intrinsics are of {self.width}x{self.height} pixels, images have the '
                f'proportions of {width}x{height}: correct camera_info'
            )

    def rays(self, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """
        Return the directions in which points of an image are, without distortion.

        :param points: pixels (x, y), centers of pixels are whole numbers, shape (m, 2).
        :param width, height: size of the image, which may be smaller than the calibrated one.
        :returns: x / z and y / z in the optical frame, shape (m, 2), float64.
        """
        if not len(points):
            return np.empty((0, 2))
        scale = np.array([self.width / width, self.height / height])
        full = ((points.astype(np.float64) + 0.5) * scale - 0.5)[:, None]
        if not any(self.distortion):
            return (full[:, 0] - self.center) / self.focal
        matrix, coefficients = np.diag([*self.focal, 1.0]), np.array(self.distortion)
        matrix[:2, 2] = self.center
        if self.model == 'equidistant':
            return np.asarray(cv2.fisheye.undistortPoints(full, matrix, coefficients))[:, 0]
        return np.asarray(cv2.undistortPoints(full, matrix, coefficients))[:, 0]


def yaw_of(mount: Sequence[float]) -> float:
    """Return the yaw of the optical axis of a pose of an optical frame, radians to the left."""
    x, y, z, w = mount[3:]
    return math.atan2(2 * (y * z - x * w), 2 * (x * z + y * w))


def mount_of(text: str) -> tuple[float, ...] | None:
    """
    Return the pose that parameter camera_transform states, None for an empty one.

    :param text: x y z and roll pitch yaw (fixed axes, radians), or a quaternion x y z w.
    :raises SettingsError: something else.
    """
    if not text.strip():
        return None
    from scipy.spatial.transform import Rotation

    try:
        numbers = [float(word) for word in text.replace(',', ' ').split()]
    except ValueError:
        numbers = []
    if len(numbers) == 6:
        numbers[3:] = Rotation.from_euler('xyz', numbers[3:]).as_quat().tolist()
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or not any(numbers[3:]):
        raise SettingsError(
            f'camera_transform = {text!r}: expected x y z roll pitch yaw, or x y z and a '
            'quaternion x y z w'
        )
    return tuple(numbers)
