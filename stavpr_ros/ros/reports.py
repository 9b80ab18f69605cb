# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Logs why images are in no window, once or seldom, with the remedy."""

from collections.abc import Callable
from dataclasses import asdict
import time

from stavpr_ros.method import Status
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros import REPORT_PERIOD
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.units import SECOND

MAX_SHORT_WINDOWS = 3  # one jump of a clock is no disorder
STAMP_JUMP = 3600.0  # seconds to an image of another recording
SKIP_SECONDS, SKIP_PERIOD = 5.0, 60.0  # of skipped images until a warning, and to the next one


class Reports:
    """
    The log of images without a match.

    :param odometry_fault: returns why no odometry can arrive, '' = nothing known.
    """

    def __init__(
        self, node: ManagedNode, statistics: Statistics, odometry_fault: Callable[[], str]
    ) -> None:
        self._node, self._statistics, self._odometry_fault = node, statistics, odometry_fault
        self._logged: set[str] = set()  # kinds, each of which is logged once
        self._since_restart = self._short_windows = 0  # images; restarts in a row before a window
        self.begin()

    def begin(self) -> None:
        """Begin another activation."""
        # stamp and time of the first image since the last keyframe [s]
        self._skipped_since: tuple[float, float] | None = None
        self._last_reason = ''  # why the last image is in no window

    def note_arrival(self) -> None:
        """Note an image that may be processed."""
        self._since_restart += 1

    def log_restart(self, reason: str, length: int) -> None:
        """Log a restart of the window, and restarts before it had its length again and again."""
        log = self._node.get_logger()
        log.info(f'window reset: {reason}')
        self._short_windows = self._short_windows + 1 if self._since_restart < length else 0
        if self._short_windows >= MAX_SHORT_WINDOWS:
            log.warning(
                f'the window was reset {self._short_windows} times in a row before it was full, '
                f'so that few images match ({reason}): publish the images in the order of their '
                'stamps, and by one publisher',
                throttle_duration_sec=REPORT_PERIOD,
            )
        self._since_restart = 0

    def log_oddities(self, texts: tuple[str, ...]) -> None:
        """Log what is odd about the inputs, each kind once."""
        for text in texts:
            self._log_once(''.join(filter(str.isalpha, text)), text)

    def log_result(self, result: ImageResult, stamp: int, settings: NodeSettings) -> None:
        """Log why an image is in no window; stamp: of the image, ns."""
        status, reason, cause = result.match.status, result.match.reason, result.cause
        if not cause:
            self._skipped_since = None
        elif status is Status.SKIPPED:
            self._log_skips(reason, cause, stamp, settings)
        elif status is Status.INVALID_IMAGE:
            counted = f'(logged once; /diagnostics counts "{cause}")'
            self._log_once(cause, f'invalid image: {reason} {counted}')
        elif status is Status.NOT_READY:
            self._node.get_logger().warning(
                f'images arrive, but cannot be matched: {reason}',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def why_no_place(self) -> str:
        """Return why no image became a place."""
        counts = self._statistics.counts()
        if not counts.received.count:
            topic = self._node.resolve_topic_name('image')
            return f'no image was received on {topic}: compare `ros2 topic list`, set image:=TOPIC'
        causes = ', '.join(f'{n} {cause}' for cause, n in counts.dropped.total.most_common())
        text = f'none of {counts.received.count} images became a place ({causes})'
        return f'{text}; the last one: {self._last_reason}' if self._last_reason else text

    def _log_once(self, kind: str, text: str) -> None:
        if kind not in self._logged:
            self._logged.add(kind)
            self._node.get_logger().warning(text)

    def _log_skips(self, reason: str, cause: str, stamp: int, settings: NodeSettings) -> None:
        """Log that a rule of keyframes skips every image, and the remedy."""
        self._last_reason, now = reason, (stamp / SECOND, time.monotonic())
        began = self._skipped_since or now
        began = self._skipped_since = began if 0 <= now[0] - began[0] < STAMP_JUMP else now
        # the stamps count too: a replay may be faster than the camera
        if not any(SKIP_SECONDS <= now[i] - began[i] < SKIP_PERIOD for i in range(2)):
            return
        if cause == 'no odometry':
            topic = self._node.resolve_topic_name('odom')
            hint = f"publish the odometry on {topic}, with stamps of the camera's clock"
            remedy = self._odometry_fault() or hint
            remedy += '; or set keyframe_distance and keyframe_angle_deg to 0'
        else:
            rules = asdict(settings.pipeline.keyframes).items()
            names = ' or '.join(f'keyframe_{name}' for name, value in rules if value)
            remedy = f'right for a camera at rest, otherwise lower {names}'
        self._node.get_logger().warning(
            f'every image is skipped: {reason}; {remedy}', throttle_duration_sec=SKIP_PERIOD
        )
