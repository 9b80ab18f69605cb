# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The health of the node: the state from which its diagnostics are made."""

from dataclasses import dataclass, replace

from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.statistics import Counts
from stavpr_ros.ros.runtime import Runtime


@dataclass(frozen=True, kw_only=True)
class Health:
    """
    The state of a node from which its diagnostics are made.

    :param counts: from :class:`~stavpr_ros.pipeline.statistics.Statistics`.
    :param state: label of the life-cycle state.
    :param topic: of the images, after remapping; ``transport``: raw or compressed.
    :param publishers: of the topic, of any QoS; ``incompatible``: those not received because of
        their QoS.
    :param remedy: for the incompatible publishers.
    :param mistyped: other message types on the topic; empty = none.
    :param odometry: fresh, stale or never; empty = no parameter needs it.
    :param queue: images in the queue of ``queue_size``; ``window``: images in the window of
        ``length``.
    :param operation: localization, mapping or loop_closure; ``mode``: robust or paper.
    :param map_path: file of the map, empty = none; ``map_state``: none, loading, loaded, growing
        or full.
    :param places: of the map; a growing map has at most ``max_places``.
    :param features: kind of the local features.
    :param backend: of the matching, with its ``device`` and ``precision``.
    :param threshold: in force; None = not set.
    :param problem: cause of the last failed transition or load; empty = none failed.
    :param missing: prerequisite of a match that is missing; empty = none.
    """

    counts: Counts
    state: str
    topic: str = ''
    transport: str
    publishers: int = 0
    incompatible: int = 0
    remedy: str = ''
    mistyped: str = ''
    odometry: str = ''
    queue: int = 0
    queue_size: int
    window: int = 0
    length: int
    operation: str
    mode: str
    map_path: str = ''
    map_state: str = 'none'
    places: int = 0
    max_places: int
    features: str = ''
    backend: str
    device: str
    precision: str
    threshold: float | None = None
    problem: str = ''
    missing: str = ''


def node_health(
    state: str, problem: str, settings: NodeSettings, counts: Counts, runtime: Runtime | None
) -> Health:
    """
    Return the health of a node; from any thread, since nothing is changed.

    :param state: label of the life-cycle state.
    :param problem: cause of the last failed transition; empty = none failed.
    :param runtime: None while the node is not configured.
    """
    backend = settings.pipeline.matching_backend(settings.operation)
    loads = state == 'configuring' and settings.map_path
    health = Health(
        counts=counts,
        state=state,
        problem=problem,
        map_state='loading' if loads else 'none',
        map_path=settings.map_path if loads else '',
        transport=settings.image_transport,
        queue_size=settings.queue_size,
        length=settings.pipeline.sequence.length,
        operation=settings.operation,
        mode=settings.pipeline.mode,
        max_places=settings.pipeline.max_places,
        backend=backend,
        device=_device(backend),
        precision=settings.pipeline.precision,
        threshold=settings.pipeline.applied_threshold(settings.operation),
    )
    return health if runtime is None else _configured(health, runtime)


def _configured(health: Health, runtime: Runtime) -> Health:
    """Add the map, the window and the subscriptions of a configured node."""
    pipeline, images, odometry = runtime.pipeline, runtime.images, runtime.odometry
    places, extractor = pipeline.places, pipeline.extractor  # the worker may replace them
    needs_poses = pipeline.settings.keyframes.needs_poses  # otherwise poses are optional
    health = replace(
        health,
        problem=health.problem or runtime.problem,
        queue=runtime.worker.waiting,
        window=pipeline.window_fill,
        map_path=runtime.loading or pipeline.path,
        map_state='loading' if runtime.loading else pipeline.map_state,
        places=0 if places is None else len(places),
        features='' if extractor is None else extractor.settings.kind,
        missing=pipeline.missing,
        odometry=odometry.freshness() if odometry is not None and needs_poses else '',
    )
    if images is None:
        return health
    return replace(
        health,
        topic=images.topic,
        publishers=images.publishers,
        incompatible=images.incompatible,
        remedy=images.remedy,
        mistyped=images.mistyped,
    )


def _device(backend: str) -> str:
    if backend == 'cuda':
        import torch

        return str(torch.cuda.get_device_name())
    return 'CPU'
