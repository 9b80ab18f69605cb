"""Images to the square size that a backbone takes."""

import cv2
import numpy as np


def resize_square(image: np.ndarray, size: int) -> np.ndarray:
    """
    Resize without keeping the aspect and without cropping.

    Shrinking averages areas, which bilinear sampling alone would not: no aliasing of fine texture.

    :param image: shape (h, w) or (h, w, 3), uint8.
    :returns: shape (size, size) or (size, size, 3), uint8.
    """
    shrinks = image.shape[0] >= size and image.shape[1] >= size
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
