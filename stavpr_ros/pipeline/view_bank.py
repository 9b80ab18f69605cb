# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A bank of views, for a camera that is rolled or tilted against the map's camera."""

import cv2
import numpy as np
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import Match, PlaceRecognizer

# of an image: rotation in degrees counterclockwise, shift downward as a share of the height
VIEWS = {
    'as they are': (0.0, 0.0),
    'rotated left by 8 degrees': (8.0, 0.0),
    'rotated right by 8 degrees': (-8.0, 0.0),
    'moved down by a tenth of the height': (0.0, 0.1),
    'moved up by a tenth of the height': (0.0, -0.1),
}
PROBABLE = 0.5  # probability above which a match counts
IN_A_ROW = 8  # images for which the same view is the most probable one, before it is adopted
PREFERENCE = 3.0  # factor of the odds of the present view
LOST = 2  # windows without a probable match, after which the other views are followed again


class ViewBank:
    """
    Recognizers of one map, one for each of ``VIEWS``, that follow the images warped alike.

    Once a view is the most probable one for ``IN_A_ROW`` images, it becomes the present one, and
    the others rest until its matches end.

    :param recognizer: of the images as they are; see :meth:`PlaceRecognizer.another`.

    ``view`` is the present one of ``VIEWS``, whose matches are returned.
    """

    def __init__(self, recognizer: PlaceRecognizer, place_map: PlaceMap) -> None:
        first, *others = VIEWS
        self._recognizers = {first: recognizer}
        self._recognizers |= {view: recognizer.another(place_map) for view in others}
        self.reset()

    @property
    def recognizer(self) -> PlaceRecognizer:
        """Return the recognizer of the present view."""
        return self._recognizers[self.view]

    def reset(self) -> None:
        """Drop all images; the present view becomes the original one."""
        self.view = next(iter(VIEWS))
        self.recognizer.reset()
        self._follow_all()

    def _follow_all(self) -> None:
        for view in VIEWS.keys() - {self.view}:
            self._recognizers[view].reset()
        self._followed, self._best, self._in_a_row, self._missed = list(VIEWS), '', 0, 0

    def set_limits(
        self, threshold: float | None, min_probability: float, max_error: float = 0.0
    ) -> None:
        """See :meth:`PlaceRecognizer.set_limits`."""
        for recognizer in self._recognizers.values():
            recognizer.set_limits(threshold, min_probability, max_error)

    def warped(self, image: np.ndarray) -> list[np.ndarray]:
        """Return an image (h, w, 3) uint8 in each view that is followed."""
        return [warped(image, *VIEWS[view]) for view in self._followed]

    def update(self, features: LocalFeatures, stamp: int, pose: np.ndarray | None) -> Match:
        """
        Add the next image, and return the match of the present view, which may change by it.

        :param features: of the images that :meth:`warped` returned, strips (W, views, d).
        """
        matches = {
            view: self._recognizers[view].update(features[i : i + 1], stamp, pose)
            for i, view in enumerate(self._followed)
        }
        if self.recognizer.is_standstill:  # equal images confirm nothing
            return matches[self.view]
        best = self._most_probable(matches)
        self._missed = 0 if best else self._missed + 1
        self._in_a_row = self._in_a_row + 1 if best == self._best else 1
        self._best = best
        if best and self._in_a_row >= IN_A_ROW:
            self.view, self._followed = best, [best]
        elif len(matches) == 1 and self._missed >= LOST * self.recognizer.window_fill:
            self._follow_all()
        return matches[self.view]

    def _most_probable(self, matches: dict[str, Match]) -> str:
        """Return the view with the most probable match, '' if none is probable."""
        fill, odds = self.recognizer.window_fill, {'': PROBABLE / (1 - PROBABLE)}
        for view, match in matches.items():
            # the window of one that was started again is not full yet
            alike = self._recognizers[view].window_fill == fill
            if alike and match.probability > PROBABLE:
                odds[view] = match.probability / max(1 - match.probability, 1e-9)
                odds[view] *= PREFERENCE if view == self.view else 1
        return max(odds, key=lambda view: odds[view])


def warped(image: np.ndarray, roll: float, shift: float) -> np.ndarray:
    """Return an image (h, w, 3) uint8 in another view; borders are replicated."""
    if not (roll or shift):
        return image
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), roll, 1)
    matrix[1, 2] += shift * height
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
