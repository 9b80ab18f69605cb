# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes whether the robot is localized, with hysteresis, and at which place: latched."""

import math

import numpy as np
from rclpy.node import Node
from stavpr_ros.mapping.merging import along_route
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.ros.messages import Outcome, Places
from stavpr_ros.ros.output import Publishers
from stavpr_ros.ros.qos import LATCHED
from std_msgs.msg import Bool, String

TRIAL, CONFIRMATIONS = 5, 3  # images after a match, and how many of them must match near it
MAX_APART, MAX_STEP = 10, 5  # places: of a confirmation from its match, and from image to image
NOWHERE = 'none'  # ~/current_node of a robot that is not localized


class Localization:
    """
    The state of being localized, image by image.

    True after a match of ``localized_probability`` that 3 of the next 5 images confirm by a match
    near it, or as far from it as a camera moves until then; false after ``lost_images`` images or
    ``lost_distance`` meters without a match.
    """

    def __init__(self, settings: NodeSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Be not localized, as at the start."""
        self.is_localized = False
        self._first = -1  # position of the match that is on trial, -1 = none
        self._tried = self._confirmed = 0  # images since then, and those that match near it
        self._unmatched = 0  # images since the last match
        self._position: np.ndarray | None = None  # at the last match, or the first one after it

    def update(
        self, place: int, probability: float, position: np.ndarray | None, lap: int = 0
    ) -> None:
        """
        Take the result of an image in the window.

        :param place: of the match, as :func:`along_route` numbers it, -1 = none.
        :param probability: of it, NaN in mode paper: any match begins a trial.
        :param position: x y z of the odometry, None = unknown.
        :param lap: places of a lap of a closed route, 0 = another one.
        """
        matched = place >= 0
        self._unmatched = 0 if matched else self._unmatched + 1
        if matched or self._position is None:
            self._position = position
        if self.is_localized:
            shift = 0.0 if position is None else float(np.linalg.norm(position - self._position))
            limits = self._settings.lost_images, self._settings.lost_distance
            if self._unmatched >= limits[0] or 0 < limits[1] <= shift:
                self.reset()
            return
        if self._first >= 0:
            self._tried += 1
            apart = abs(place - self._first)
            apart = min(apart, abs(lap - apart)) if lap else apart
            self._confirmed += matched and apart <= max(MAX_APART, MAX_STEP * self._tried)
            if self._confirmed >= CONFIRMATIONS:
                self.is_localized, self._first = True, -1
                return
            if self._tried >= TRIAL:
                self._first = -1
        certain = math.isnan(probability) or probability >= self._settings.localized_probability
        if self._first < 0 and matched and certain:
            self._first, self._tried, self._confirmed = place, 0, 0


class LocalizedPublisher(Publishers):
    """Publishes ``~/localized``, of its ``state``, and ``~/current_node`` when they change."""

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        super().__init__(node)
        self.state = Localization(settings)
        self._localized = self._make(Bool, '~/localized', LATCHED)
        self._current_node = self._make(String, '~/current_node', LATCHED)
        self._places: Places = None
        self._route: tuple[np.ndarray, int] = np.arange(0), 0
        self._published: tuple[bool | None, str] = (None, '')
        self._publish(NOWHERE)

    def publish(self, outcome: Outcome) -> None:
        """Publish what an image has changed; a robot is localized on a map, not on a route."""
        place_map, match = outcome.place_map, outcome.match
        if outcome.places is not self._places:
            self.reset()
            self._places = outcome.places
            if place_map is not None:
                self._route = along_route(place_map)
        if outcome.result.cause or place_map is None:
            return
        pose = outcome.about.pose
        position = None if pose is None else pose[:3]
        positions, lap = self._route
        along = int(positions[match.newest]) if match.accepted else -1
        self.state.update(along, match.probability, position, lap)
        if not self.state.is_localized:
            self._publish(NOWHERE)
        elif outcome.newest is not None:
            self._publish(outcome.newest.identifier or str(match.newest))

    def reset(self) -> None:
        """Be not localized: another map, or the window was emptied."""
        self.state.reset()
        self._places = None
        self._publish(NOWHERE)

    def close(self) -> None:
        """Destroy the publishers, and release the map."""
        self._places = None
        super().close()

    def _publish(self, current_node: str) -> None:
        is_localized = self.state.is_localized
        last, self._published = self._published, (is_localized, current_node)
        if last[0] is not is_localized:
            self._send(self._localized, Bool(data=is_localized))
        if last[1] != current_node:
            self._send(self._current_node, String(data=current_node))
