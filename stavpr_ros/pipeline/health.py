"""Everything that diagnostics are made from."""

from dataclasses import dataclass

from stavpr_ros.pipeline.statistics import Snapshot


@dataclass(frozen=True, kw_only=True)
class Health:
    """
    Everything that diagnostics are made from.

    :param snapshot: the counts.
    :param state: label of the lifecycle state: unconfigured, inactive, active, finalized, configuring ...
    :param topic: of the images, after remapping; ``publishers`` are on it now, whatever their QoS.
    :param transport: raw, compressed ...
    :param queue: images that wait, of at most ``queue_size``; ``window`` are in the window, of ``length``.
    :param operation: localization, mapping or loop_closure; ``mode``: how places are recognized.
    :param map_path: its file, empty = none; ``map_state``: none, loading, loaded, growing or full.
    :param places: of the map, now; a growing map stops at ``max_places``.
    :param features: kind of the local features.
    :param backend: where images are matched, on which ``device``, in which ``precision``.
    :param threshold: in force; None = not set.
    :param problem: why the last transition failed, or the last map was not loaded; empty = nothing failed.
    :param incompatible: publishers that are there and refused because of their QoS.
    :param remedy: what to do about them, in words.
    :param mistyped: what publishers on the topic send that is not the transport's type; empty = none does.
    :param missing: what is missing before there can be a match, in words; empty = nothing.
    :param odometry: fresh, stale or never; empty = no parameter needs it.
    """

    snapshot: Snapshot
    state: str
    topic: str
    transport: str
    publishers: int
    queue: int
    queue_size: int
    window: int
    length: int
    operation: str
    mode: str
    map_path: str
    map_state: str
    places: int
    max_places: int
    features: str
    backend: str
    device: str
    precision: str
    threshold: float | None = None
    problem: str = ''
    incompatible: int = 0
    remedy: str = ''
    mistyped: str = ''
    missing: str = ''
    odometry: str = ''
