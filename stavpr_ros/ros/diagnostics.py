"""From the node's health to diagnostics: what is wrong, in plain words, and what to do; no node in here."""

import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import Header

from stavpr_ros.pipeline.health import Health
from stavpr_ros.pipeline.statistics import RATE_WINDOW, Snapshot
from stavpr_ros.ros.diagnostic_values import (
    input_values,
    key_values,
    map_values,
    processing_values,
    recognition_values,
)

SILENCE = 2.0
"""Seconds without an image after which something is wrong with an active node's input."""

BUSY = 0.8
"""Below this share of its time at work the worker keeps up, and a full queue means a burst."""

JUDGED = ('match', 'no match')
UNDECODED = ('invalid image', 'dropped', 'not ready', 'skipped')
"""Statuses on images, the latter on those that need not have been decoded."""

NEXT_TRANSITION = {'unconfigured': 'configure', 'inactive': 'activate'}

Finding = tuple[bytes, str]  # level and message


def diagnostic_array(health: Health, node: str, stamp: Time) -> DiagnosticArray:
    """
    Return the four statuses of a node: input, map, recognition, processing.

    :param node: its full name, with which the statuses' names begin; a leading slash is left out.
    :param stamp: of the array.
    """
    active = health.state == 'active'
    idle = [] if active else [(DiagnosticStatus.OK, _inactive(health.state, node))]
    parts = {
        'input': (idle or _input(health), input_values(health)),
        'map': (_map(health), map_values(health)),
        'recognition': (idle or _recognition(health), recognition_values(health)),
        'processing': (idle or _processing(health), processing_values(health)),
    }
    return DiagnosticArray(
        header=Header(stamp=stamp),
        status=[
            DiagnosticStatus(
                level=max(level for level, _ in findings),
                name=f'{node.lstrip("/")}: {part}',
                # The worst first: monitors cut long messages.
                message='; '.join(text for _, text in sorted(findings, key=lambda f: f[0], reverse=True)),
                hardware_id=health.device,
                values=key_values(values),
            )
            for part, (findings, values) in parts.items()
        ],
    )


def _inactive(state: str, node: str) -> str:
    """
    Return what is said of a node that is not active, which is no fault, so its level is OK.

    Somebody brought the node into that state, or has not taken it further, on purpose; a warning that is
    always on when a robot stands by is soon read by nobody. STALE means that nothing was heard from a node.
    """
    transition = NEXT_TRANSITION.get(state)
    remedy = f"; 'ros2 lifecycle set {node} {transition}' takes it further" if transition else ''
    return f'{state}: no image is processed{remedy}'


def _input(health: Health) -> list[Finding]:
    """What is to be said of the images that come to an active node."""
    snapshot = health.snapshot
    age = snapshot.uptime if snapshot.received_age is None else snapshot.received_age
    findings = []
    if age > SILENCE:
        findings.append(_silence(health, age))
    elif health.incompatible and health.publishers > 1 and snapshot.received:
        # were there one publisher only, it would not be one that was refused: images come
        text = f'{_of(health.incompatible, "publisher")} refused for QoS, while images of others come: '
        findings.append((DiagnosticStatus.WARN, text + _qos_remedy(health)))
    findings += _invalid(snapshot)
    if lost := snapshot.recent_drops.get('lost in transport', 0):
        remedy = "give the publisher a bigger shared-memory segment (README, 'If images are lost')"
        text = f'{_of(lost, "image")} lost in transport in the last {RATE_WINDOW} s: {remedy}'
        findings.append((DiagnosticStatus.WARN, text))
    if health.odometry in ('stale', 'never'):
        what = 'came never' if health.odometry == 'never' else 'comes no more'
        text = f'odometry, which a parameter needs, {what}: start it, compare its topic and its stamps'
        findings.append((DiagnosticStatus.WARN, text))
    elif without := snapshot.recent_drops.get('no odometry', 0):
        text = f'{_of(without, "image")} had no odometry of their time: compare the stamps of both'
        findings.append((DiagnosticStatus.WARN, text))
    if findings:
        return findings
    if snapshot.received_age is None:
        return [(DiagnosticStatus.OK, f'waiting for the first image on {health.topic}')]
    return [(DiagnosticStatus.OK, f'{snapshot.rate_in:.1f} images a second on {health.topic}')]


def _silence(health: Health, age: float) -> Finding:
    """Say that no image comes, and the likeliest reason."""
    since = 'yet' if health.snapshot.received_age is None else f'for {age:.0f} s'
    nothing = f'no image {since} on {health.topic}: '
    if not health.publishers:
        text = "no publisher; look for the camera's topic with 'ros2 topic list' and remap to it: "
        return DiagnosticStatus.WARN, f'{nothing}{text}--ros-args -r image:=TOPIC'
    if health.incompatible:
        text = f'{_of(health.incompatible, "publisher")} refused for QoS: '
        return DiagnosticStatus.ERROR, nothing + text + _qos_remedy(health)
    if health.mistyped:
        text = f'{health.mistyped} is published there: compare image_transport and the topic'
        return DiagnosticStatus.ERROR, nothing + text
    text = f'{_of(health.publishers, "publisher")} there, but silent; is the bag paused, the camera off?'
    return DiagnosticStatus.WARN, nothing + text


def _qos_remedy(health: Health) -> str:
    return health.remedy or f"compare 'ros2 topic info --verbose {health.topic}'"


def _invalid(snapshot: Snapshot) -> list[Finding]:
    """Say how many of the recent images could not be decoded."""
    invalid = {cause: n for cause, n in snapshot.recent_drops.items() if cause.startswith('invalid')}
    if not invalid:
        return []
    kinds = ', '.join(f'{cause.removeprefix("invalid").lstrip(": ")} {n}' for cause, n in invalid.items())
    where = f'in the last {RATE_WINDOW} s were invalid ({kinds}): see the log'
    # A keyframe was decoded once: images that are compared with one do not come from a broken camera.
    valid = sum(n for status, n in snapshot.recent_statuses.items() if status not in UNDECODED)
    if valid or 'not a keyframe' in snapshot.recent_drops:
        return [(DiagnosticStatus.WARN, f'{_of(sum(invalid.values()), "image")} {where}')]
    return [
        (
            DiagnosticStatus.ERROR,
            f'all images {where}, and docs/node.md for what is read',
        )
    ]


def _map(health: Health) -> list[Finding]:
    """What is to be said of the map, in every state: a failed transition leaves the node not active."""
    places = _of(health.places, 'place')
    if health.problem:
        in_use = health.map_state in ('loaded', 'growing', 'full')
        level = DiagnosticStatus.WARN if in_use else DiagnosticStatus.ERROR
        return [(level, health.problem + (f'; the map in use has {places}' if in_use else ''))]
    warning = DiagnosticStatus.WARN if health.state == 'active' else DiagnosticStatus.OK
    if health.map_state == 'none':
        return [(warning, 'no map: set map_path or call ~/load_map')]
    if health.map_state == 'loading':
        meanwhile = f'; until then the old one is used, of {places}' if health.places else ''
        return [(DiagnosticStatus.OK, f'loading {health.map_path}{meanwhile}')]
    if health.map_state == 'growing':
        return [(DiagnosticStatus.OK, f'growing: {places} of at most {health.max_places}')]
    if health.map_state == 'full':
        remedy = 'save it with ~/save_map, then raise max_places'
        return [(warning, f'full: mapping stopped at {places} (max_places); {remedy}')]
    return [(DiagnosticStatus.OK, f'{places} of {health.map_path or "a map without a file"}')]


def _recognition(health: Health) -> list[Finding]:
    """What is to be said of the answers of an active node."""
    if health.operation == 'mapping':
        return [(DiagnosticStatus.OK, 'mapping: images become places, none is recognized')]
    if health.map_state == 'loading' and not health.places:
        return [(DiagnosticStatus.OK, 'waiting for the map')]
    if health.missing:
        return [(DiagnosticStatus.WARN, f'no match is possible: {health.missing}')]
    if health.window < health.length:
        return [(DiagnosticStatus.OK, f'warming up: {health.window} of {health.length} images')]
    snapshot = health.snapshot
    judged = sum(snapshot.recent_statuses.get(status, 0) for status in JUDGED)
    matched = snapshot.recent_statuses.get('match', 0)
    share = f'{matched} of {_of(judged, "image")} matched in the last {RATE_WINDOW} s'
    return [(DiagnosticStatus.OK, '; '.join(filter(None, (share, _last_answer(snapshot)))))]


def _last_answer(snapshot: Snapshot) -> str:
    """Return the last answer in words; empty if there was none."""
    if not snapshot.status:
        return ''
    place = f', place {snapshot.place}' if snapshot.place >= 0 else ''
    distance = '' if math.isnan(snapshot.distance) else f', distance {snapshot.distance:.3f}'
    reason = f' ({snapshot.reason})' if snapshot.reason else ''
    return f'last answer: {snapshot.status}{place}{distance}{reason}'


def _processing(health: Health) -> list[Finding]:
    """What is to be said of the speed of an active node."""
    snapshot = health.snapshot
    if failed := snapshot.recent_drops.get('internal error', 0):
        text = f'{_of(failed, "image")} failed in the last {RATE_WINDOW} s by an internal error: see the log'
        return [(DiagnosticStatus.ERROR, text)]
    if dropped := snapshot.recent_drops.get('queue full', 0):
        lost = f'{_of(dropped, "image")} dropped in the last {RATE_WINDOW} s, since the queue was full: '
        return [(DiagnosticStatus.WARN, lost + _why_full(health))]
    if snapshot.work is None:
        return [(DiagnosticStatus.OK, f'no image in the last {RATE_WINDOW} s')]
    text = f'{snapshot.work.mean:.1f} ms an image, {snapshot.rate_out:.1f} answered a second'
    return [(DiagnosticStatus.OK, text)]


def _why_full(health: Health) -> str:
    """Compare what comes with what can be done, and say what helps."""
    snapshot = health.snapshot
    comes = f'{snapshot.rate_in:.1f} come a second'
    if snapshot.work is None:
        return f'{comes}, and none was finished; is a map being loaded, the machine busy?'
    takes = f'{comes}, and one takes {snapshot.work.mean:.1f} ms'
    if snapshot.rate_in * snapshot.work.mean < BUSY * 1e3:
        return f'{takes}, which is fast enough: they come in bursts; raise queue_size'
    half = '' if health.precision == 'float16' else 'precision float16, '
    remedy = f'set max_rate or keyframe_*, {half}a smaller map'
    return f'{takes}, so {1e3 / snapshot.work.mean:.1f} can be done: {remedy}'


def _of(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'
