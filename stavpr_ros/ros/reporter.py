"""Publishes the diagnostics from a thread of its own, so that neither a paused bag nor work silences them."""

import threading
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray

from stavpr_ros.pipeline.health import Health
from stavpr_ros.ros.diagnostics import diagnostic_array
from stavpr_ros.ros.runtime import Runtime

if TYPE_CHECKING:
    from stavpr_ros.ros.node import PlaceRecognitionNode


class Reporter:
    """
    Publishes on ``/diagnostics``, on the steady clock.

    :param node: whose health it is.
    :param period: seconds.
    """

    def __init__(self, node: 'PlaceRecognitionNode', period: float) -> None:
        self._node, self._period = node, period
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
                self._report()
            except Exception as error:  # the next report may be possible; this one is said to be missing
                self._node.get_logger().error(
                    f'no diagnostics: {type(error).__name__}: {error}', throttle_duration_sec=10.0
                )

    def _report(self) -> None:
        node = self._node
        stamp = node.get_clock().now().to_msg()
        self._publisher.publish(diagnostic_array(health(node), node.get_fully_qualified_name(), stamp))
        node.publish_map_info()


def health(node: 'PlaceRecognitionNode') -> Health:
    """Collect what the diagnostics tell; from any thread, since it only looks."""
    settings, runtime = node.settings, node.configured
    backend = settings.pipeline.matching_backend(settings.operation)
    return Health(
        snapshot=node.statistics.snapshot(),
        state=node.state,
        problem=node.problem or (runtime.problem if runtime is not None else ''),
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
        **(_of_runtime(runtime) if runtime is not None else _unconfigured(node)),
    )


_UNCONFIGURED: dict[str, Any] = {
    'topic': '',
    'publishers': 0,
    'queue': 0,
    'window': 0,
    'map_path': '',
    'map_state': 'none',
    'places': 0,
    'features': '',
}


def _unconfigured(node: 'PlaceRecognitionNode') -> dict[str, Any]:
    """Return what there is to tell of a node that has no map yet, but may be about to have one."""
    path = node.settings.map_path
    loads = node.state == 'configuring' and path
    return _UNCONFIGURED | ({'map_state': 'loading', 'map_path': path} if loads else {})


def _of_runtime(runtime: Runtime) -> dict[str, Any]:
    """Return what there is to tell of a configured node only."""
    pipeline, images, odometry = runtime.pipeline, runtime.images, runtime.odometry
    places, extractor = pipeline.places, pipeline.extractor
    needs_poses = pipeline.settings.keyframes.needs_poses  # else they are welcome, not needed
    told = _UNCONFIGURED | {
        'queue': runtime.worker.waiting,
        'window': pipeline.window_fill,
        'map_path': runtime.loading or pipeline.path,
        'map_state': 'loading' if runtime.loading else pipeline.map_state,
        'places': 0 if places is None else len(places),
        'features': '' if extractor is None else extractor.settings.kind,
        'missing': pipeline.missing,
        'odometry': odometry.freshness() if odometry is not None and needs_poses else '',
    }
    if images is not None:
        told |= {
            'topic': images.topic,
            'publishers': images.publishers,
            'remedy': images.remedy,
            'incompatible': images.incompatible,
            'mistyped': images.mistyped,
        }
    return told


def _device(backend: str) -> str:
    """Name the device."""
    if backend == 'cuda':
        import torch

        return str(torch.cuda.get_device_name())
    return 'CPU'
