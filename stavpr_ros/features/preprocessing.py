"""Images to the square size that a backbone takes."""

import cv2
import numpy as np

from stavpr_ros.errors import SettingsError

METHODS = ('bilinear', 'area')


def check_method(method: str) -> None:
    """
    Refuse a method that there is not.

    :raises SettingsError: names those that there are.
    """
    if method not in METHODS:
        raise SettingsError(f'resize = {method!r} must be one of {", ".join(METHODS)}')


def resize_square(image: np.ndarray, size: int, method: str) -> np.ndarray:
    """
    Resize without keeping the aspect and without cropping.

    :param image: shape (h, w) or (h, w, 3), uint8.
    :param method: ``bilinear``, as the paper's networks were fed; ``area`` averages where it shrinks, so
        that fine texture does not alias.
    :returns: shape (size, size) or (size, size, 3), uint8.
    """
    shrinks = image.shape[0] >= size and image.shape[1] >= size
    averages = method == 'area' and shrinks
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if averages else cv2.INTER_LINEAR)
