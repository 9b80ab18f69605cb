# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The health of a node: its state, and the findings on it: level, cause and remedy."""

from collections.abc import Iterator
from dataclasses import dataclass, field
import math

from diagnostic_msgs.msg import DiagnosticStatus
from stavpr_msgs.msg import MapInfo
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.operations import NOT_A_KEYFRAME
from stavpr_ros.pipeline.statistics import ImageCounts, RECENT
from stavpr_ros.ros.edges import MAX_WAITING
from stavpr_ros.ros.input import InputStatus

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

SILENCE = 2.0  # seconds without an image from which on the input of an active node has a fault
BUSY = 0.8  # share of its time that the worker is busy; below it, a full queue is due to a burst
MISSING = 0.05  # share of the received images; from this estimate on missing ones are reported
MAX_IMAGES_WITHOUT_MATCH = 5  # in lengths of a window; after more, the limit is suspect
BLANK_CONTRAST = 3.0  # standard deviation of 255; the darkest tunnels of Nordland have 3
NEXT_TRANSITION = {'unconfigured': 'configure', 'inactive': 'activate'}
INVALID = 'invalid: '  # first word of the causes of images that cannot be decoded
RECENTLY = f'in the last {RECENT} s'

Finding = tuple[bytes, str]  # level and message


@dataclass(frozen=True, kw_only=True)
class Health:
    """The state of a node from which its diagnostics are made; empty texts = none."""

    state: str  # label of the life-cycle state
    problem: str = ''  # cause of the last failed transition or load
    hardware_id: str = ''  # robot and camera
    settings: NodeSettings
    counts: ImageCounts
    map_info: MapInfo
    loading: str = ''  # path of the map that a service loads
    input: InputStatus = field(default_factory=InputStatus)  # while the node is active
    odometry: str = ''  # fresh, stale or never, while it is subscribed to
    queue: int = 0  # waiting images
    window: int = 0  # images in it
    missing: str = ''  # prerequisite of a match
    odometry_fault: str = ''  # why no odometry can arrive on its topic
    camera: str = 'not needed'  # whether the camera of the edges is known, or why not
    contrast: float = math.nan  # standard deviation of the last image, of 255; NaN = unknown
    applied_threshold: float | None = None  # the recognizer's; None = the settings'

    oddities: tuple[str, ...] = ()  # of the inputs

    localized: bool = False
    sends_transform: bool = False  # map -> odom, of the last match

    @property
    def limit(self) -> float | None:
        """Return the distance below which a window is matched, None = not set."""
        limit = self.settings.pipeline.applied_threshold
        return limit if self.applied_threshold is None else self.applied_threshold

    @property
    def map_path(self) -> str:
        """Return the file of the map that is loaded or in use; empty = none."""
        return self.loading or self.map_info.path

    @property
    def odometry_required(self) -> bool:
        """Whether images without a pose are skipped; places of recorded maps can do without."""
        return self.settings.pipeline.keyframes.needs_poses


def findings(health: Health, node: str) -> dict[str, list[Finding]]:
    """Return the findings on each part of a node, one or more."""
    of_map = [_map_finding(health)]
    if health.state != 'active':
        # it is so on purpose: a permanent warning on standby would be ignored
        transition = NEXT_TRANSITION.get(health.state)
        remedy = f"; run 'ros2 lifecycle set {node} {transition}'" if transition else ''
        idle = [(OK, f'{health.state}: no image is processed{remedy}')]
        return {'input': idle, 'map': of_map, 'recognition': idle, 'processing': idle}
    images, topic = health.counts.received, health.input.topic
    normal = f'{images.rate:.1f} images per second on {topic}'
    if images.age is None:
        normal = f'waiting for the first image on {topic}'
    recognition = [_recognition_finding(health)]
    if health.sends_transform and not health.localized:
        recognition.append((WARN, 'not localized: the transform on /tf is of the last match'))
    return {
        'input': [*_silence(health), *_image_faults(health)] or [(OK, normal)],
        'map': of_map,
        'recognition': recognition,
        'processing': [_processing_finding(health), *_edge_faults(health)],
    }


def _silence(health: Health) -> Iterator[Finding]:
    """Yield the likeliest reason why no image arrives, or none of a publisher."""
    source, age = health.input, health.counts.received.age
    silent = (health.counts.uptime if age is None else age) > SILENCE
    nothing = f'no image {"yet" if age is None else f"for {age:.0f} s"} on {source.topic}: '
    refusal = f'{_plural(source.incompatible, "publisher")} refused for QoS'
    qos = source.remedy or f"compare 'ros2 topic info --verbose {source.topic}'"
    if silent and not source.publishers:
        find = "find the camera's topic with 'ros2 topic list', remap to it"
        remedy = source.remedy or f'{find} with --ros-args -r image:=TOPIC'
        yield WARN, f'{nothing}no publisher; {remedy}'
    elif silent and source.incompatible:
        yield ERROR, f'{nothing}{refusal}: {qos}'
    elif silent and source.mistyped:
        remedy = 'compare image_transport and the topic'
        yield ERROR, f'{nothing}{source.mistyped} is published there: {remedy}'
    elif silent:
        silence = f'{_plural(source.publishers, "publisher")} there, but silent'
        yield WARN, f'{nothing}{silence}; check for a paused bag or a camera that is off'
    elif source.incompatible and source.publishers > 1 and age is not None:
        # a single publisher is not the refused one: images arrive
        yield WARN, f'{refusal}, while images of others arrive: {qos}'


def loss(health: Health) -> str:
    """Return the finding on images that were lost in transport, '' = none."""
    count = health.counts.dropped.recent['lost in transport']
    remedy = f'{health.input.loss_remedy} (docs/troubleshooting.md, images are lost)'
    return f'{_plural(count, "image")} lost in transport {RECENTLY}: {remedy}' if count else ''


def _image_faults(health: Health) -> Iterator[Finding]:
    """Yield the findings on images that arrived or were lost, and on their odometry."""
    counts, drops = health.counts, health.counts.dropped.recent
    yield from ((WARN, text) for text in health.oddities)
    invalid = {cause: n for cause, n in drops.items() if cause.startswith(INVALID)}
    if invalid:
        kinds = ', '.join(f'{cause.removeprefix(INVALID)} {n}' for cause, n in invalid.items())
        text = f'{RECENTLY} were invalid ({kinds}): see the log'
        if counts.answered.recent or NOT_A_KEYFRAME in drops:  # others could be decoded
            yield WARN, f'{_plural(sum(invalid.values()), "image")} {text}'
        else:
            yield ERROR, f'all images {text}, and docs/node.md for the supported encodings'
    missing = counts.missing.recent.total()
    if fault := loss(health):
        yield WARN, fault
    elif missing > MISSING * RECENT * counts.received.rate:
        remedy = 'none was lost in transport: check the camera driver, its cable and its exposure'
        text = f'about {_plural(missing, "image")} missing by their stamps {RECENTLY}'
        yield WARN, f'{text}; {remedy}'
    absent = health.odometry in ('stale', 'never')
    if absent and (health.odometry_required or health.odometry_fault):
        need = 'required by a parameter' if health.odometry_required else 'for poses of the map'
        state = 'was never received' if health.odometry == 'never' else 'has stopped'
        remedy = health.odometry_fault or 'start it, compare its topic and its stamps'
        yield WARN, f'odometry, {need}, {state}: {remedy}'
    elif without := drops['no odometry']:
        text = f'{_plural(without, "image")} without odometry at their stamps {RECENTLY}'
        yield WARN, f'{text}: compare both'
    if counts.received.rate and health.contrast < BLANK_CONTRAST:
        text = f'the images show nothing (standard deviation {health.contrast:.1f} of 255)'
        remedy = 'check the lens cap, the exposure and the driver'
        yield WARN, f'{text}: {remedy}, look at them with rqt_image_view'


def _map_finding(health: Health) -> Finding:
    """Return the finding on the map, in any state of the node."""
    info, settings = health.map_info, health.settings.pipeline
    places = _plural(info.places, 'place')
    warning = WARN if health.state == 'active' else OK
    if health.problem:
        in_use = info.state in ('loaded', 'growing', 'full')
        text = f'{health.problem}; the map in use has {places}'
        return (WARN, text) if in_use else (ERROR, health.problem)
    if info.state == 'none':
        return warning, 'no map is loaded: set map_path, or call ~/load_map'
    if info.state == 'loading':
        meanwhile = f'; the old map of {places} is used meanwhile' if info.places else ''
        return OK, f'loading {health.map_path}{meanwhile}'
    if info.state == 'growing':
        return OK, f'growing: {places} of at most {settings.max_places}'
    if info.state == 'full':
        remedy = 'save it with ~/save_map, then raise max_places'
        return warning, f'full: mapping stopped at {places} (max_places); {remedy}'
    text = f'{places} of {health.map_path or "a map without a file"}'
    unmet = health.settings.unmet(info.has_poses, info.has_thumbnails)
    return (warning, f'{text}: {unmet}') if unmet else (OK, text)


def _recognition_finding(health: Health) -> Finding:
    counts, length = health.counts, health.settings.pipeline.sequence.length
    if health.settings.operation == 'mapping':
        hits, others = (counts.answered.recent[status] for status in ('match', 'mapped'))
        matched = f'{hits} of {_plural(hits + others, "image")} matched {RECENTLY}'
        matched = matched if counts.answered.total['match'] else 'none is recognized'
        return OK, f'mapping: images become places, {matched}'
    if health.map_info.state == 'loading' and not health.map_info.places:
        return OK, 'waiting for the map'
    if health.missing:
        return WARN, f'no match is possible: {health.missing}'
    if obstacle := _why_no_match_is_possible(health):
        return WARN, obstacle
    if health.window < length:
        return OK, f'warming up: {health.window} of {length} images'
    hits, rejected = (counts.answered.recent[status] for status in ('match', 'no match'))
    text = f'{hits} of {_plural(hits + rejected, "image")} matched {RECENTLY}'
    if counts.status:
        place = f', place {counts.place}' if counts.place >= 0 else ''
        distance = '' if math.isnan(counts.distance) else f', distance {counts.distance:.3f}'
        reason = f' ({counts.reason})' if counts.reason else ''
        text += f'; last result: {counts.status}{place}{distance}{reason}'
    return OK, text


def _why_no_match_is_possible(health: Health) -> str:
    """Return why no image can be matched on a loaded map, or was, '' = one may be."""
    counts, settings, places = health.counts, health.settings.pipeline, health.map_info.places
    if health.settings.operation != 'localization' or health.map_info.state != 'loaded':
        return ''
    if places < (length := settings.sequence.length):
        return (
            f'the map has fewer places ({places}) than a window has images (sequence_length '
            f'{length}): record a longer map, with smaller keyframe distances, or set a shorter '
            'sequence_length'
        )
    images, limit = counts.answered.total['no match'], health.limit
    if counts.answered.total['match'] or images < MAX_IMAGES_WITHOUT_MATCH * length:
        return ''
    never = f'none of {images} images was ever matched'
    if limit is not None and counts.nearest < limit:
        return f'{never}: the geometric check rejects all, lower min_inliers or set it to none'
    if settings.mode == 'robust':
        best = f'probability {1 - counts.nearest:.3f}'
        remedy = (
            f'raise max_error ({settings.max_error:g})'
            if settings.max_error
            else f'lower min_probability ({settings.min_probability:g})'
        )
    else:
        best, remedy = f'distance {counts.nearest:.3f}', f'raise threshold ({limit:g})'
    return (
        f'{never}, the best had {best}: compare the route, the direction and the keyframe rules '
        f'with those of the map, or {remedy}'
    )


def _processing_finding(health: Health) -> Finding:
    counts, drops = health.counts, health.counts.dropped.recent
    mean, _ = counts.times.get('work', (math.nan, math.nan))  # [ms]
    rate, takes = counts.received.rate, f', one takes {mean:.1f} ms'
    if errors := drops['internal error']:
        text = f'{_plural(errors, "image")} failed {RECENTLY} by an internal error: see the log'
        return ERROR, text
    if not drops['queue full']:
        if math.isnan(mean):
            return OK, f'no image {RECENTLY}'
        return OK, f'{mean:.1f} ms an image, {counts.answered.rate:.1f} results per second'
    if math.isnan(mean):
        why = ', none was finished; check for a map being loaded or a busy machine'
    elif rate * mean < BUSY * 1e3:
        why = f'{takes}, which is fast enough: they arrive in bursts; raise queue_size'
    else:
        int8 = 'precision int8, ' if health.settings.pipeline.precision == 'float32' else ''
        remedy = f'set max_rate or keyframe_*, {int8}a smaller map'
        why = f'{takes}, so {1e3 / mean:.1f} per second are possible: {remedy}'
    losses = f'{_plural(drops["queue full"], "image")} dropped {RECENTLY}, the queue was full'
    return WARN, f'{losses}: {rate:.1f} images per second arrive{why}'


def _edge_faults(health: Health) -> Iterator[Finding]:
    """Yield the finding on loop closures that PnP had no time for."""
    edges = health.counts.edges.recent
    if drops := edges['dropped']:
        text = f'{drops} of {_plural(edges.total(), "loop closure")} without a relative pose'
        why = f'PnP is slower than they come, more than {MAX_WAITING} waited'
        remedy = 'set max_rate or keyframe_distance, or free a processor core'
        yield WARN, f'{text} {RECENTLY}: {why}; {remedy}'


def _plural(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'
