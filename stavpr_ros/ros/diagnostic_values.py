"""The numbers behind the diagnostics, as key and value."""

import math
import re

from diagnostic_msgs.msg import KeyValue

from stavpr_ros.pipeline.health import Health
from stavpr_ros.pipeline.statistics import RATE_WINDOW, Snapshot

INPUT_CAUSES = ('invalid', 'lost in transport', 'no odometry')
"""What the causes begin with that are shown with the input; the others are shown with the processing."""

Value = str | int | float | None


def input_values(health: Health) -> dict[str, Value]:
    snapshot = health.snapshot
    return {
        'topic': health.topic,
        'transport': health.transport,
        'publishers': health.publishers,
        'publishers_refused': health.incompatible,
        'received': snapshot.received,
        'rate_in_hz': snapshot.rate_in,
        'last_image_age_s': snapshot.received_age,
        'gaps': snapshot.gaps,
        'longest_gap_s': snapshot.longest_gap,
        'jumps_back': snapshot.jumps_back,
        'longest_jump_back_s': snapshot.longest_jump_back,
        'odometry': health.odometry or 'not needed',
        **_drop_values(snapshot, from_input=True),
    }


def map_values(health: Health) -> dict[str, Value]:
    return {
        'state': health.map_state,
        'path': health.map_path or None,
        'places': health.places,
        'max_places': health.max_places,
        'features': health.features,
    }


def recognition_values(health: Health) -> dict[str, Value]:
    snapshot = health.snapshot
    return {
        'operation': health.operation,
        'mode': health.mode,
        'threshold': health.threshold,
        'window': health.window,
        'length': health.length,
        'last_status': snapshot.status or None,
        'last_reason': snapshot.reason or None,
        'last_place': snapshot.place if snapshot.place >= 0 else None,
        'last_distance': snapshot.distance,
        'last_answer_age_s': snapshot.answered_age,
        **{_key('statuses', status): count for status, count in snapshot.statuses.items()},
    }


def processing_values(health: Health) -> dict[str, Value]:
    snapshot = health.snapshot
    times = {'total': snapshot.total, 'work': snapshot.work, **snapshot.stages}
    measured = {name: time for name, time in times.items() if time is not None}
    return {
        'state': health.state,
        'uptime_s': snapshot.uptime,
        'answered': snapshot.answered,
        'rate_out_hz': snapshot.rate_out,
        'queue': health.queue,
        'queue_size': health.queue_size,
        'backend': health.backend,
        'device': health.device,
        'precision': health.precision,
        **_drop_values(snapshot, from_input=False),
        **{_key(name, 'mean_ms'): time.mean for name, time in measured.items()},
        **{_key(name, 'max_ms'): time.max for name, time in measured.items()},
    }


def _drop_values(snapshot: Snapshot, from_input: bool) -> dict[str, Value]:
    """Return the drops by cause, since the start and recently."""
    values: dict[str, Value] = {}
    for cause, count in snapshot.drops.items():
        if cause.startswith(INPUT_CAUSES) == from_input:
            values[_key('dropped', cause)] = count
            values[_key('dropped', cause, f'{RATE_WINDOW}s')] = snapshot.recent_drops.get(cause, 0)
    return values


def _key(*words: str) -> str:
    """Return a key in snake case made of free words."""
    return '_'.join(filter(None, re.split(r'\W+', ' '.join(words).lower())))


def key_values(values: dict[str, Value]) -> list[KeyValue]:
    """Return values as messages."""
    return [KeyValue(key=key, value=_text(value)) for key, value in values.items()]


def _text(value: Value) -> str:
    """Return a value as monitors show it; three decimals are enough for Hz, ms, s and distances."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return 'none'
    return f'{value:.3f}' if isinstance(value, float) else str(value)
