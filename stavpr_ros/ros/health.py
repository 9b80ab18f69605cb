# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The health of a node: its state, and the findings on it: level, cause and remedy."""

from dataclasses import dataclass, field
import math

from diagnostic_msgs.msg import DiagnosticStatus
from stavpr_msgs.msg import MapInfo
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.statistics import ImageCounts, RECENT
from stavpr_ros.ros.edges import EdgeCounts
from stavpr_ros.ros.faults import blank_images, never_matched, short_map
from stavpr_ros.ros.input import InputStatus

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

SILENCE = 2.0
"""Seconds without an image from which on the input of an active node has a fault."""

BUSY = 0.8
"""Share of its time that the worker is busy; below it, a full queue is due to a burst."""

MISSING = 0.05
"""Share of the received images; from this estimate of missing ones on it is reported."""

DECIDED = ('match', 'no match')
NOT_DECODED = ('invalid image', 'dropped', 'not ready', 'skipped')
NEXT_TRANSITION = {'unconfigured': 'configure', 'inactive': 'activate'}

Finding = tuple[bytes, str]  # level and message


@dataclass(frozen=True, kw_only=True)
class Health:
    """
    The state of a node from which its diagnostics are made.

    :param state: label of the life-cycle state.
    :param problem: cause of the last failed transition or load; empty = none failed.
    :param loading: path of the map that is being loaded by a service; empty = none.
    :param input: topic and publishers of the images; empty while the node is not active.
    :param hardware_id: robot and camera of the statuses.
    :param odometry: fresh, stale or never; empty = it is not subscribed to.
    :param queue: waiting images; ``window``: images in the window.
    :param missing: prerequisite of a match that is missing; empty = none.
    :param odometry_fault: why no odometry can arrive on its topic; empty = unknown.
    :param camera: whether the camera of the edges is known, or why not.
    :param edges: counts of the edges.
    :param contrast: standard deviation of the last image, of 255; NaN = unknown.
    """

    state: str
    problem: str = ''
    hardware_id: str = ''
    settings: NodeSettings
    counts: ImageCounts
    map_info: MapInfo
    loading: str = ''
    input: InputStatus = field(default_factory=InputStatus)
    odometry: str = ''
    queue: int = 0
    window: int = 0
    missing: str = ''
    odometry_fault: str = ''
    camera: str = 'not needed'
    edges: EdgeCounts = field(default_factory=lambda: EdgeCounts({}))
    contrast: float = math.nan

    @property
    def map_path(self) -> str:
        """Return the file of the map that is loaded or in use; empty = none."""
        return self.loading or self.map_info.path

    @property
    def odometry_required(self) -> bool:
        """Whether images without a pose are skipped; places of recorded maps can do without."""
        return self.settings.pipeline.keyframes.needs_poses

    @property
    def backend(self) -> str:
        """Return the backend of the image distances."""
        return self.settings.pipeline.matching_backend(self.settings.operation)


def inactive_text(state: str, node: str) -> str:
    """Return the message of a node that is not active."""
    transition = NEXT_TRANSITION.get(state)
    remedy = f"; run 'ros2 lifecycle set {node} {transition}'" if transition else ''
    return f'{state}: no image is processed{remedy}'


def input_findings(health: Health) -> list[Finding]:
    """Return the findings on the images and odometry of an active node."""
    counts = health.counts
    recent = f'in the last {RECENT} s'
    age = counts.uptime if counts.received_age is None else counts.received_age
    findings = []
    if age > SILENCE:
        findings.append(_silence(health, age))
    elif (
        health.input.incompatible
        and health.input.publishers > 1
        and counts.received_age is not None
    ):
        # a single publisher is not the refused one: images arrive
        refused = f'{_of(health.input.incompatible, "publisher")} refused for QoS'
        findings.append((WARN, f'{refused}, while images of others arrive: {_qos_remedy(health)}'))
    findings += _invalid(counts)
    findings += _lost(health)
    if health.odometry in ('stale', 'never') and (
        health.odometry_required or health.odometry_fault
    ):
        need = 'required by a parameter' if health.odometry_required else 'for poses of the map'
        state = 'was never received' if health.odometry == 'never' else 'has stopped'
        remedy = health.odometry_fault or 'start it, compare its topic and its stamps'
        findings.append((WARN, f'odometry, {need}, {state}: {remedy}'))
    elif without := counts.recent_drops.get('no odometry', 0):
        text = f'{_of(without, "image")} without odometry at their stamps {recent}: compare both'
        findings.append((WARN, text))
    if counts.rate_in and (blank := blank_images(health.contrast)):
        findings.append((WARN, blank))
    if findings:
        return findings
    if counts.received_age is None:
        return [(OK, f'waiting for the first image on {health.input.topic}')]
    return [(OK, f'{counts.rate_in:.1f} images per second on {health.input.topic}')]


def _silence(health: Health, age: float) -> Finding:
    """Return the likeliest reason why no image arrives."""
    since = 'yet' if health.counts.received_age is None else f'for {age:.0f} s'
    nothing = f'no image {since} on {health.input.topic}: '
    if not health.input.publishers:
        remedy = "find the camera's topic with 'ros2 topic list', remap to it"
        return WARN, f'{nothing}no publisher; {remedy} with --ros-args -r image:=TOPIC'
    if health.input.incompatible:
        refused = f'{_of(health.input.incompatible, "publisher")} refused for QoS: '
        return ERROR, nothing + refused + _qos_remedy(health)
    if health.input.mistyped:
        remedy = 'compare image_transport and the topic'
        return ERROR, f'{nothing}{health.input.mistyped} is published there: {remedy}'
    return WARN, (
        f'{nothing}{_of(health.input.publishers, "publisher")} there, but silent; '
        'check for a paused bag or a camera that is off'
    )


def _qos_remedy(health: Health) -> str:
    return health.input.remedy or f"compare 'ros2 topic info --verbose {health.input.topic}'"


def _invalid(counts: ImageCounts) -> list[Finding]:
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


def _lost(health: Health) -> list[Finding]:
    """Return the finding on images lost on the way, or before that, if there are any."""
    counts = health.counts
    recent = f'in the last {RECENT} s'
    lost = counts.recent_drops.get('lost in transport', 0)
    if lost:
        remedy = f'{health.input.loss_remedy} (docs/troubleshooting.md, images are lost)'
        return [(WARN, f'{_of(lost, "image")} lost in transport {recent}: {remedy}')]
    if counts.recent_missing > MISSING * RECENT * counts.rate_in:
        text = f'about {_of(counts.recent_missing, "image")} missing by their stamps {recent}'
        remedy = 'none was lost in transport: check the camera driver, its cable and its exposure'
        return [(WARN, f'{text}; {remedy}')]
    return []


def map_finding(health: Health) -> Finding:
    """Return the finding on the map, in any state of the node."""
    places = _of(health.map_info.places, 'place')
    if health.problem:
        in_use = health.map_info.state in ('loaded', 'growing', 'full')
        return (
            (WARN, f'{health.problem}; the map in use has {places}')
            if in_use
            else (ERROR, health.problem)
        )
    warning = WARN if health.state == 'active' else OK
    if health.map_info.state == 'none':
        return warning, 'no map: set map_path or call ~/load_map'
    if health.map_info.state == 'loading':
        meanwhile = (
            f'; the old map of {places} is used meanwhile' if health.map_info.places else ''
        )
        return OK, f'loading {health.map_path}{meanwhile}'
    if health.map_info.state == 'growing':
        return OK, f'growing: {places} of at most {health.settings.pipeline.max_places}'
    if health.map_info.state == 'full':
        remedy = 'save it with ~/save_map, then raise max_places'
        return warning, f'full: mapping stopped at {places} (max_places); {remedy}'
    if health.settings.pipeline.geometric and not health.map_info.has_thumbnails:
        places += ' without thumbnails, so that geometric_check checks no match,'
    return OK, f'{places} of {health.map_path or "a map without a file"}'


def recognition_finding(health: Health) -> Finding:
    """Return the finding on the results of an active node."""
    counts = health.counts
    if health.settings.operation == 'mapping':
        return OK, 'mapping: images become places, none is recognized'
    if health.map_info.state == 'loading' and not health.map_info.places:
        return OK, 'waiting for the map'
    if health.missing:
        return WARN, f'no match is possible: {health.missing}'
    settings = health.settings.pipeline
    if health.settings.operation == 'localization' and health.map_info.state == 'loaded':
        hopeless = short_map(health.map_info.places, settings.sequence.length)
        hopeless = hopeless or never_matched(counts, settings)
        if hopeless:
            return WARN, hopeless
    if health.window < health.settings.pipeline.sequence.length:
        return (
            OK,
            f'warming up: {health.window} of {health.settings.pipeline.sequence.length} images',
        )
    decided = sum(counts.recent_statuses.get(status, 0) for status in DECIDED)
    matched = counts.recent_statuses.get('match', 0)
    text = f'{matched} of {_of(decided, "image")} matched in the last {RECENT} s'
    if counts.status:
        place = f', place {counts.place}' if counts.place >= 0 else ''
        distance = '' if math.isnan(counts.distance) else f', distance {counts.distance:.3f}'
        reason = f' ({counts.reason})' if counts.reason else ''
        text += f'; last result: {counts.status}{place}{distance}{reason}'
    return OK, text


def processing_finding(health: Health) -> Finding:
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
    int8 = '' if health.settings.pipeline.precision == 'int8' else 'precision int8, '
    remedy = f'set max_rate or keyframe_*, {int8}a smaller map'
    return f'{takes}, so {1e3 / counts.work.mean:.1f} per second are possible: {remedy}'


def _of(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'
