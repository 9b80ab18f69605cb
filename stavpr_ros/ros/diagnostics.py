# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a node: four statuses with level, cause, remedy and values."""

from collections.abc import Callable, Mapping
import math
import re
import threading

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from stavpr_ros.pipeline.statistics import ImageCounts, RECENT
from stavpr_ros.ros.health import (
    Health,
    inactive_text,
    input_findings,
    map_finding,
    OK,
    processing_finding,
    recognition_finding,
)
from std_msgs.msg import Header

INPUT_CAUSES = ('invalid', 'lost in transport', 'no odometry')
"""
First words of the causes shown with the input; the other causes are shown with the processing.
"""

Value = str | int | float | None


class DiagnosticsPublisher:
    """
    Publishes on ``/diagnostics`` from a thread with a steady clock: a paused bag does not stop it.

    :param period: seconds.
    :param health: returns the state of the node; called from the thread.
    """

    def __init__(self, node: Node, period: float, health: Callable[[], Health]) -> None:
        self._node, self._period, self._health = node, period, health
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='diagnostics', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(self._period):
            try:
                stamp = self._node.get_clock().now().to_msg()
                name = self._node.get_fully_qualified_name()
                self._publisher.publish(diagnostic_array(self._health(), name, stamp))
            except Exception as error:  # the next report may succeed
                self._node.get_logger().error(
                    f'no diagnostics: {type(error).__name__}: {error}', throttle_duration_sec=10.0
                )


def diagnostic_array(health: Health, node: str, stamp: Time) -> DiagnosticArray:
    """
    Return the four statuses of a node: input, map, recognition, processing.

    :param node: its full name, the first part of the statuses' names without the leading slash.
    """
    # a node that is not active is so on purpose: a permanent warning on standby would be ignored
    idle = [] if health.state == 'active' else [(OK, inactive_text(health.state, node))]
    parts = {
        'input': (idle or input_findings(health), _input_values(health)),
        'map': ([map_finding(health)], _map_values(health)),
        'recognition': (idle or [recognition_finding(health)], _recognition_values(health)),
        'processing': (idle or [processing_finding(health)], _processing_values(health)),
    }
    statuses = []
    for part, (findings, values) in parts.items():
        findings.sort(key=lambda finding: finding[0], reverse=True)  # monitors cut long messages
        statuses.append(
            DiagnosticStatus(
                level=findings[0][0],
                name=f'{node.lstrip("/")}: {part}',
                message='; '.join(text for _, text in findings),
                hardware_id=health.hardware_id,
                values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
            )
        )
    return DiagnosticArray(header=Header(stamp=stamp), status=statuses)


def one_status(
    node: Node, part: str, level: bytes, text: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """Return the diagnostics of a node with one part, stamped now."""
    status = DiagnosticStatus(
        level=level,
        name=f'{node.get_fully_qualified_name().lstrip("/")}: {part}',
        message=text,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
    header = Header(stamp=node.get_clock().now().to_msg())
    return DiagnosticArray(header=header, status=[status])


# the numbers behind the messages


def _input_values(health: Health) -> dict[str, Value]:
    counts = health.counts
    return {
        'topic': health.input.topic,
        'transport': health.settings.image_transport,
        'publishers': health.input.publishers,
        'publishers_refused': health.input.incompatible,
        'reliability': health.input.reliability or None,
        'received': counts.received,
        'missing_by_stamps_estimate': counts.missing,
        f'missing_by_stamps_estimate_{RECENT}s': counts.recent_missing,
        'rate_in_hz': counts.rate_in,
        'last_image_age_s': counts.received_age,
        'gaps': counts.gaps,
        'longest_gap_s': counts.longest_gap,
        'jumps_back': counts.jumps_back,
        'longest_jump_back_s': counts.longest_jump_back,
        'odometry': _odometry(health),
        **_drop_values(counts, of_input=True),
    }


def _odometry(health: Health) -> str:
    if not health.odometry:
        return 'not needed'
    return health.odometry + ('' if health.odometry_required else ', optional')


def _map_values(health: Health) -> dict[str, Value]:
    return {
        'state': health.map_info.state,
        'path': health.map_path or None,
        'places': health.map_info.places,
        'max_places': health.settings.pipeline.max_places,
        'features': health.map_info.features,
    }


def _recognition_values(health: Health) -> dict[str, Value]:
    counts, settings = health.counts, health.settings.pipeline
    limit = 'min_probability' if settings.mode == 'robust' else 'threshold'
    return {
        'operation': health.settings.operation,
        'mode': settings.mode,
        limit: getattr(settings, limit),
        'window': health.window,
        'length': settings.sequence.length,
        'last_status': counts.status or None,
        'last_reason': counts.reason or None,
        'last_place': counts.place if counts.place >= 0 else None,
        'last_distance': counts.distance,
        'last_answer_age_s': counts.answered_age,
        'camera': health.camera,
        **{_key('edges', source): count for source, count in health.edges.sources.items()},
        'last_edge_reason': health.edges.reason or None,
        **{_key('statuses', status): count for status, count in counts.statuses.items()},
    }


def _processing_values(health: Health) -> dict[str, Value]:
    counts = health.counts
    times = {'total': counts.total, 'work': counts.work, **counts.stages}
    measured = {name: time for name, time in times.items() if time is not None}
    return {
        'state': health.state,
        'uptime_s': counts.uptime,
        'answered': counts.answered,
        'rate_out_hz': counts.rate_out,
        'queue': health.queue,
        'queue_size': health.settings.queue_size,
        'backend': health.backend,
        'device': _device(health.backend),
        'precision': health.settings.pipeline.precision,
        **_drop_values(counts, of_input=False),
        **{_key(name, 'mean_ms'): time.mean for name, time in measured.items()},
        **{_key(name, 'max_ms'): time.max for name, time in measured.items()},
    }


def _drop_values(counts: ImageCounts, of_input: bool) -> dict[str, Value]:
    """Return the drops by cause, since the start and recently."""
    values: dict[str, Value] = {}
    for cause, count in counts.drops.items():
        if cause.startswith(INPUT_CAUSES) == of_input:
            values[_key('dropped', cause)] = count
            values[_key('dropped', cause, f'{RECENT}s')] = counts.recent_drops.get(cause, 0)
    return values


def _key(*words: str) -> str:
    """Return a key in snake case."""
    return '_'.join(filter(None, re.split(r'\W+', ' '.join(words).lower())))


def _text(value: Value) -> str:
    """Return a value as monitors show it, with three decimals of Hz, ms, s and distances."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return 'none'
    return f'{value:.3f}' if isinstance(value, float) else str(value)


def _device(backend: str) -> str:
    if backend == 'cuda':
        import torch

        return str(torch.cuda.get_device_name())
    return 'CPU'
