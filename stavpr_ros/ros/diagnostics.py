# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a node from its health: four statuses with level, cause, remedy, values."""

from collections.abc import Callable
import math
import re
import threading

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from stavpr_ros.pipeline.statistics import Counts, RECENT
from stavpr_ros.ros.health import Health
from std_msgs.msg import Header

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

SILENCE = 2.0
"""Seconds without an image from which on the input of an active node has a fault."""

BUSY = 0.8
"""Share of its time that the worker is busy; below it, a full queue is due to a burst."""

DECIDED = ('match', 'no match')
NOT_DECODED = ('invalid image', 'dropped', 'not ready', 'skipped')
INPUT_CAUSES = ('invalid', 'lost in transport', 'no odometry')
"""
First words of the causes shown with the input; the other causes are shown with the processing.
"""

NEXT_TRANSITION = {'unconfigured': 'configure', 'inactive': 'activate'}

Finding = tuple[bytes, str]  # level and message
Value = str | int | float | None


class DiagnosticsPublisher:
    """
    Publishes on ``/diagnostics`` from a thread with a steady clock: a paused bag does not stop it.

    :param node: the publisher's node.
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
    :param stamp: of the array.
    """
    # a node that is not active is so on purpose: a permanent warning on standby would be ignored
    idle = [] if health.state == 'active' else [(OK, _inactive(health.state, node))]
    parts = {
        'input': (idle or _input(health), _input_values(health)),
        'map': ([_map(health)], _map_values(health)),
        'recognition': (idle or [_recognition(health)], _recognition_values(health)),
        'processing': (idle or [_processing(health)], _processing_values(health)),
    }
    statuses = []
    for part, (findings, values) in parts.items():
        findings.sort(key=lambda finding: finding[0], reverse=True)  # monitors cut long messages
        statuses.append(
            DiagnosticStatus(
                level=findings[0][0],
                name=f'{node.lstrip("/")}: {part}',
                message='; '.join(text for _, text in findings),
                hardware_id=health.device,
                values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
            )
        )
    return DiagnosticArray(header=Header(stamp=stamp), status=statuses)


def _inactive(state: str, node: str) -> str:
    transition = NEXT_TRANSITION.get(state)
    remedy = f"; run 'ros2 lifecycle set {node} {transition}'" if transition else ''
    return f'{state}: no image is processed{remedy}'


def _input(health: Health) -> list[Finding]:
    """Return the findings on the images and odometry of an active node."""
    counts = health.counts
    recent = f'in the last {RECENT} s'
    age = counts.uptime if counts.received_age is None else counts.received_age
    findings = []
    if age > SILENCE:
        findings.append(_silence(health, age))
    elif health.incompatible and health.publishers > 1 and counts.received:
        # a single publisher is not the refused one: images arrive
        refused = f'{_of(health.incompatible, "publisher")} refused for QoS'
        findings.append((WARN, f'{refused}, while images of others arrive: {_qos_remedy(health)}'))
    findings += _invalid(counts)
    if lost := counts.recent_drops.get('lost in transport', 0):
        remedy = "give the publisher a bigger shared-memory segment (README, 'If images are lost')"
        findings.append((WARN, f'{_of(lost, "image")} lost in transport {recent}: {remedy}'))
    if health.odometry in ('stale', 'never'):
        state = 'was never received' if health.odometry == 'never' else 'has stopped'
        remedy = 'start it, compare its topic and its stamps'
        findings.append((WARN, f'odometry, required by a parameter, {state}: {remedy}'))
    elif without := counts.recent_drops.get('no odometry', 0):
        text = f'{_of(without, "image")} without odometry at their stamps {recent}: compare both'
        findings.append((WARN, text))
    if findings:
        return findings
    if counts.received_age is None:
        return [(OK, f'waiting for the first image on {health.topic}')]
    return [(OK, f'{counts.rate_in:.1f} images per second on {health.topic}')]


def _silence(health: Health, age: float) -> Finding:
    """Return the likeliest reason why no image arrives."""
    since = 'yet' if health.counts.received_age is None else f'for {age:.0f} s'
    nothing = f'no image {since} on {health.topic}: '
    if not health.publishers:
        remedy = "find the camera's topic with 'ros2 topic list', remap to it"
        return WARN, f'{nothing}no publisher; {remedy} with --ros-args -r image:=TOPIC'
    if health.incompatible:
        refused = f'{_of(health.incompatible, "publisher")} refused for QoS: '
        return ERROR, nothing + refused + _qos_remedy(health)
    if health.mistyped:
        remedy = 'compare image_transport and the topic'
        return ERROR, f'{nothing}{health.mistyped} is published there: {remedy}'
    return WARN, (
        f'{nothing}{_of(health.publishers, "publisher")} there, but silent; '
        'check for a paused bag or a camera that is off'
    )


def _qos_remedy(health: Health) -> str:
    return health.remedy or f"compare 'ros2 topic info --verbose {health.topic}'"


def _invalid(counts: Counts) -> list[Finding]:
    """Return the finding on recent images that could not be decoded, if there are any."""
    invalid = {cause: n for cause, n in counts.recent_drops.items() if cause.startswith('invalid')}
    if not invalid:
        return []
    kinds = ', '.join(
        f'{cause.removeprefix("invalid").lstrip(": ")} {n}' for cause, n in invalid.items()
    )
    text = f'in the last {RECENT} s were invalid ({kinds}): see the log'
    # keyframes were decoded, and an image compared with one too
    valid = sum(n for status, n in counts.recent_statuses.items() if status not in NOT_DECODED)
    if valid or 'not a keyframe' in counts.recent_drops:
        return [(WARN, f'{_of(sum(invalid.values()), "image")} {text}')]
    return [(ERROR, f'all images {text}, and docs/node.md for the supported encodings')]


def _map(health: Health) -> Finding:
    """Return the finding on the map, in any state of the node."""
    places = _of(health.places, 'place')
    if health.problem:
        in_use = health.map_state in ('loaded', 'growing', 'full')
        return (
            (WARN, f'{health.problem}; the map in use has {places}')
            if in_use
            else (ERROR, health.problem)
        )
    warning = WARN if health.state == 'active' else OK
    if health.map_state == 'none':
        return warning, 'no map: set map_path or call ~/load_map'
    if health.map_state == 'loading':
        meanwhile = f'; the old map of {places} is used meanwhile' if health.places else ''
        return OK, f'loading {health.map_path}{meanwhile}'
    if health.map_state == 'growing':
        return OK, f'growing: {places} of at most {health.max_places}'
    if health.map_state == 'full':
        remedy = 'save it with ~/save_map, then raise max_places'
        return warning, f'full: mapping stopped at {places} (max_places); {remedy}'
    return OK, f'{places} of {health.map_path or "a map without a file"}'


def _recognition(health: Health) -> Finding:
    """Return the finding on the results of an active node."""
    counts = health.counts
    if health.operation == 'mapping':
        return OK, 'mapping: images become places, none is recognized'
    if health.map_state == 'loading' and not health.places:
        return OK, 'waiting for the map'
    if health.missing:
        return WARN, f'no match is possible: {health.missing}'
    if health.window < health.length:
        return OK, f'warming up: {health.window} of {health.length} images'
    decided = sum(counts.recent_statuses.get(status, 0) for status in DECIDED)
    matched = counts.recent_statuses.get('match', 0)
    text = f'{matched} of {_of(decided, "image")} matched in the last {RECENT} s'
    if counts.status:
        place = f', place {counts.place}' if counts.place >= 0 else ''
        distance = '' if math.isnan(counts.distance) else f', distance {counts.distance:.3f}'
        reason = f' ({counts.reason})' if counts.reason else ''
        text += f'; last result: {counts.status}{place}{distance}{reason}'
    return OK, text


def _processing(health: Health) -> Finding:
    """Return the finding on the speed of an active node."""
    counts = health.counts
    recent = f'in the last {RECENT} s'
    if failed := counts.recent_drops.get('internal error', 0):
        return ERROR, f'{_of(failed, "image")} failed {recent} by an internal error: see the log'
    if dropped := counts.recent_drops.get('queue full', 0):
        return (
            WARN,
            f'{_of(dropped, "image")} dropped {recent}, the queue was full: {_why_full(health)}',
        )
    if counts.work is None:
        return OK, f'no image {recent}'
    return OK, f'{counts.work.mean:.1f} ms an image, {counts.rate_out:.1f} results per second'


def _why_full(health: Health) -> str:
    """Compare the rate of the images with the possible rate; name the remedy."""
    counts = health.counts
    arriving = f'{counts.rate_in:.1f} images per second arrive'
    if counts.work is None:
        return f'{arriving}, none was finished; check for a map being loaded or a busy machine'
    takes = f'{arriving}, one takes {counts.work.mean:.1f} ms'
    if counts.rate_in * counts.work.mean < BUSY * 1e3:
        return f'{takes}, which is fast enough: they arrive in bursts; raise queue_size'
    float16 = '' if health.precision == 'float16' else 'precision float16, '
    remedy = f'set max_rate or keyframe_*, {float16}a smaller map'
    return f'{takes}, so {1e3 / counts.work.mean:.1f} per second are possible: {remedy}'


def _of(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'


# the numbers behind the messages


def _input_values(health: Health) -> dict[str, Value]:
    counts = health.counts
    return {
        'topic': health.topic,
        'transport': health.transport,
        'publishers': health.publishers,
        'publishers_refused': health.incompatible,
        'received': counts.received,
        'rate_in_hz': counts.rate_in,
        'last_image_age_s': counts.received_age,
        'gaps': counts.gaps,
        'longest_gap_s': counts.longest_gap,
        'jumps_back': counts.jumps_back,
        'longest_jump_back_s': counts.longest_jump_back,
        'odometry': health.odometry or 'not needed',
        **_drop_values(counts, of_input=True),
    }


def _map_values(health: Health) -> dict[str, Value]:
    return {
        'state': health.map_state,
        'path': health.map_path or None,
        'places': health.places,
        'max_places': health.max_places,
        'features': health.features,
    }


def _recognition_values(health: Health) -> dict[str, Value]:
    counts = health.counts
    return {
        'operation': health.operation,
        'mode': health.mode,
        'threshold': health.threshold,
        'window': health.window,
        'length': health.length,
        'last_status': counts.status or None,
        'last_reason': counts.reason or None,
        'last_place': counts.place if counts.place >= 0 else None,
        'last_distance': counts.distance,
        'last_answer_age_s': counts.answered_age,
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
        'queue_size': health.queue_size,
        'backend': health.backend,
        'device': health.device,
        'precision': health.precision,
        **_drop_values(counts, of_input=False),
        **{_key(name, 'mean_ms'): time.mean for name, time in measured.items()},
        **{_key(name, 'max_ms'): time.max for name, time in measured.items()},
    }


def _drop_values(counts: Counts, of_input: bool) -> dict[str, Value]:
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
