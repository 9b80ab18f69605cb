# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a node: four statuses with level, cause, remedy and values."""

from collections.abc import Callable, Mapping
import math
import re

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from stavpr_ros.pipeline.statistics import ImageCounts, RECENT
from stavpr_ros.ros.health import findings, Health, loss
from stavpr_ros.ros.worker import Beat
from std_msgs.msg import Header

# first words of the causes shown with the input; the others are shown with the processing
INPUT_CAUSES = ('invalid', 'lost in transport', 'no odometry')

LOSS_PERIOD = 60.0  # seconds between two warnings of lost images in the log

Value = str | int | float | None


def publish_diagnostics(node: Node, period: float, state: Callable[[], Health]) -> Beat:
    """
    Publish on ``/diagnostics`` from a thread, which is returned.

    :param period: seconds.
    :param state: returns the state of the node; called from the thread.
    """
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def report() -> None:
        stamp, health = node.get_clock().now().to_msg(), state()
        publisher.publish(diagnostic_array(health, node.get_fully_qualified_name(), stamp))
        if text := loss(health):
            node.get_logger().warning(text, throttle_duration_sec=LOSS_PERIOD)

    return Beat(node, period, report, 'diagnostics')


def diagnostic_array(health: Health, node: str, stamp: Time) -> DiagnosticArray:
    """
    Return the four statuses of a node: input, map, recognition, processing.

    :param node: its full name, the first part of the statuses' names without the leading slash.
    """
    values = _values(health)
    statuses = []
    for part, rows in findings(health, node).items():
        rows.sort(key=lambda finding: finding[0], reverse=True)  # monitors cut long messages
        text = '; '.join(text for _, text in rows)
        texts = {key: _text(value) for key, value in values[part].items()}
        statuses.append(_status(f'{node}: {part}', rows[0][0], text, texts))
        statuses[-1].hardware_id = health.hardware_id
    return DiagnosticArray(header=Header(stamp=stamp), status=statuses)


def one_status(
    node: Node, part: str, level: bytes, text: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """Return the diagnostics of a node with one part, stamped now."""
    status = _status(f'{node.get_fully_qualified_name()}: {part}', level, text, values)
    header = Header(stamp=node.get_clock().now().to_msg())
    return DiagnosticArray(header=header, status=[status])


def _values(health: Health) -> dict[str, dict[str, Value]]:
    """Return the numbers behind the messages, by part."""
    counts, settings, info = health.counts, health.settings.pipeline, health.map_info
    backend = settings.matching_backend(health.settings.operation)
    return {
        'input': _input_values(health),
        'map': {
            'state': info.state,
            'path': health.map_path or None,
            'places': info.places,
            'max_places': settings.max_places,
            'features': info.features,
        },
        'recognition': _recognition_values(health),
        'processing': {
            'state': health.state,
            'uptime_s': counts.uptime,
            'answered': counts.answered.count,
            'rate_out_hz': counts.answered.rate,
            'queue': health.queue,
            'queue_size': health.settings.queue_size,
            'backend': backend,
            'device': _device(backend),
            'precision': settings.precision,
            **_drops(counts, of_input=False),
            **{_key(name, 'mean_ms'): mean for name, (mean, _) in counts.times.items()},
            **{_key(name, 'max_ms'): largest for name, (_, largest) in counts.times.items()},
        },
    }


def _input_values(health: Health) -> dict[str, Value]:
    counts, odometry = health.counts, health.odometry or 'not needed'
    if health.odometry and not health.odometry_required:
        odometry += ', optional'
    return {
        'topic': health.input.topic,
        'transport': health.settings.image_transport,
        'publishers': health.input.publishers,
        'publishers_refused': health.input.incompatible,
        'reliability': health.input.reliability or None,
        'received': counts.received.count,
        'missing_by_stamps_estimate': counts.missing.count,
        f'missing_by_stamps_estimate_{RECENT}s': counts.missing.recent.total(),
        'rate_in_hz': counts.received.rate,
        'last_image_age_s': counts.received.age,
        'gaps': counts.gaps,
        'longest_gap_s': counts.longest_gap,
        'jumps_back': counts.jumps_back,
        'longest_jump_back_s': counts.longest_jump_back,
        'odometry': odometry,
        **_drops(counts, of_input=True),
    }


def _recognition_values(health: Health) -> dict[str, Value]:
    counts, settings = health.counts, health.settings.pipeline
    limit: dict[str, Value] = {'threshold': settings.threshold}
    if settings.mode == 'robust' and health.limit is not None:
        limit = {'min_probability': 1 - health.limit}
    return {
        'operation': health.settings.operation,
        'mode': str(settings.mode),
        **limit,
        'window': health.window,
        'length': settings.sequence.length,
        'last_status': counts.status or None,
        'last_reason': counts.reason or None,
        'last_newest_index': counts.place if counts.place >= 0 else None,
        'last_distance': counts.distance,
        'last_answer_age_s': counts.answered.age,
        'localized': health.localized,
        'sends_transform': health.sends_transform,
        'camera': health.camera,
        **{_key('edges', source): count for source, count in counts.edges.total.items()},
        f'edges_dropped_{RECENT}s': counts.edges.recent['dropped'],
        'last_edge_reason': counts.edge_reason or None,
        **{_key('statuses', name): count for name, count in counts.answered.total.items()},
    }


def _drops(counts: ImageCounts, of_input: bool) -> dict[str, Value]:
    """Return the drops by cause, since the start and recently."""
    values: dict[str, Value] = {}
    for cause, count in counts.dropped.total.items():
        if cause.startswith(INPUT_CAUSES) == of_input:
            values[_key('dropped', cause)] = count
            values[_key('dropped', cause, f'{RECENT}s')] = counts.dropped.recent[cause]
    return values


def _status(name: str, level: bytes, text: str, values: Mapping[str, object]) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name.lstrip('/'), message=text, values=pairs)


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
