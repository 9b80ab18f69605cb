"""The place-recognition node: its life cycle and its parameters."""

import gc
import threading
import traceback
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.timer import Timer

from stavpr_msgs.msg import MapInfo
from stavpr_ros.devices import why_no_cuda
from stavpr_ros.errors import SettingsError, SourceError, StavprError
from stavpr_ros.output_file import require_room
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros.diagnostics import DiagnosticsPublisher
from stavpr_ros.ros.health import Health, node_health
from stavpr_ros.ros.parameter_table import declare_parameters
from stavpr_ros.ros.parameters import BY_NAME, PARAMETERS
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.runtime import Runtime
from stavpr_ros.ros.services import Services
from stavpr_ros.ros.settings import NodeSettings, node_settings, unknown_parameters
from stavpr_ros.ros.worker import PATIENCE

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PlaceRecognitionNode(ManagedNode):
    """
    Recognizes where images were taken; publishes one ``~/match`` for each image on ``image``.

    A managed node: configuring loads the map and the model and compiles the kernels, activating subscribes,
    deactivating stops, cleaning up frees. With parameter ``autostart`` it configures and activates itself
    as soon as it spins. It wants an executor that serves on threads: see :data:`THREADS`.

    :raises StavprError: parameters that cannot work together, or a backend that is not here.
    """

    THREADS = 4  # a transition, a service and parameters may each take long; images take the fourth

    def __init__(self, **options: Any) -> None:
        self._lock = threading.RLock()  # one change at a time: transitions and parameters
        super().__init__('stavpr', **options)
        for said in unknown_parameters(self._parameter_overrides):
            self.get_logger().warning(said)
        self._settings = node_settings(declare_parameters(self, PARAMETERS))
        self._verbosity = 'default'
        self._apply_verbosity(self._settings.verbosity)
        self._runtime: Runtime | None = None
        self.statistics = Statistics()
        self.problem = ''  # why the last transition failed
        self._map_info = self.create_publisher(MapInfo, '~/map_info', LATCHED)
        self._told: MapInfo | None = None
        self._telling = threading.RLock()  # what was published last is what was true last
        self._served = Services(self)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.add_post_set_parameters_callback(self._on_parameters_set)
        backwards = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jumps = self.get_clock().create_jump_callback(backwards, post_callback=self._on_clock_jump)
        self._diagnostics = DiagnosticsPublisher(self, self._settings.diagnostics_period, self._health)
        self._start: Timer | None = None
        if self._settings.autostart:
            self._start = self.create_timer(
                0.0,
                self._on_start,
                callback_group=MutuallyExclusiveCallbackGroup(),
                clock=Clock(clock_type=ClockType.STEADY_TIME),
            )

    @property
    def settings(self) -> NodeSettings:
        """The parameters in force."""
        return self._settings

    @property
    def configured(self) -> Runtime | None:
        """What the node has while it is configured, None while it is not."""
        return self._runtime

    @property
    def runtime(self) -> Runtime:
        """
        What the node has while it is configured.

        :raises StavprError: it is not.
        """
        if self._runtime is None:
            because = f' ({self.problem})' if self.problem else ''
            ended = self.state == 'finalized'
            remedy = 'start it anew' if ended else 'configure it first, `ros2 lifecycle set NODE configure`'
            raise StavprError(f'the node is {self.state}{because}: {remedy}')
        return self._runtime

    # the life cycle

    def _on_start(self) -> None:
        """Configure and activate, once; again only when a parameter was changed after a failure."""
        assert self._start is not None
        self._start.cancel()
        if self.state != 'unconfigured':
            return
        tried = self._settings
        if self.advance(self.trigger_configure):
            if not self.ending.is_set():
                self.advance(self.trigger_activate)
        elif self.state == 'unconfigured' and self._settings is not tried:
            self._start.reset()  # a parameter was set while that failed

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load map and model, warm the kernels, make the publishers."""
        return self._transition('configure', self._configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to images."""
        # publishers first: an image may come, and be answered, as soon as there is a subscription
        publishers = super().on_activate
        return self._transition('activate', lambda: publishers(state), self._activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hear no images any more."""
        return self._transition('deactivate', self._deactivate, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free map, model and publishers."""
        return self._transition('clean up', self._free, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free everything, from any state."""
        return self._transition('shut down', self._free, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free everything, so that the node can be configured again."""
        self._free()
        return TransitionCallbackReturn.SUCCESS

    def _transition(
        self,
        name: str,
        act: Callable[[], object],
        then: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        """Do what a transition means; an error leads to the error state, with its reason."""
        try:
            with self._lock:
                act()
                result = then(state)
        except StavprError as error:
            if self.ending.is_set():
                return TransitionCallbackReturn.ERROR
            self.problem = f'cannot {name}: {error}'
        except Exception as error:  # rclpy would swallow it
            self.problem = f'cannot {name}: {type(error).__name__}: {error}'
            self.get_logger().error(traceback.format_exc())
        else:
            self.problem = ''
            return result
        self.get_logger().error(self.problem)
        return TransitionCallbackReturn.ERROR

    def _configure(self) -> None:
        settings = self._settings
        backend, wish = settings.pipeline.backend, settings.backend
        reason = (why_no_cuda() or 'there is a device') if wish == 'auto' else 'as asked for'
        self.get_logger().info(f'backend {backend} ({reason})')
        _require_room(settings.save_path)
        if settings.map_path:
            self._tell(MapInfo(operation=settings.operation, state='loading', path=settings.map_path))
        self._runtime = Runtime(self, settings, self.statistics)
        self._runtime.on_loading = self.publish_map_info
        if missing := self._runtime.pipeline.missing:
            self.get_logger().warning(f'waiting, no image can be matched: {missing}')
        self.publish_map_info()
        # what is there now stays: Python's collector would look through all of it again and again, half a
        # second each time, in the middle of an image
        gc.collect()
        gc.freeze()

    def _activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.statistics.reset()
        self.runtime.activate()
        return TransitionCallbackReturn.SUCCESS

    def _deactivate(self) -> None:
        self.runtime.deactivate()

    def _free(self) -> None:
        with self._lock:
            runtime, self._runtime = self._runtime, None
            if runtime is not None:
                runtime.close()
                del runtime
            if self._told is not None:
                self._tell(MapInfo(operation=self._settings.operation, state='none'))
        gc.unfreeze()
        gc.collect()  # runtime and worker refer to each other: the map would stay until Python tidies up
        if self._settings.pipeline.backend == 'cuda':
            import torch

            torch.cuda.empty_cache()

    # parameters

    def set_parameters(self, parameters: list[Parameter]) -> list[SetParametersResult]:
        """Set parameters, one thread at a time: what is stored is what is in force."""
        with self._lock:
            return list(super().set_parameters(parameters))

    def set_parameters_atomically(self, parameters: list[Parameter]) -> SetParametersResult:
        """Set parameters, all or none, one thread at a time."""
        with self._lock:
            return super().set_parameters_atomically(parameters)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Check all parameters together; apply what may change while the node runs; all of it or nothing."""
        changes = {parameter.name: parameter.value for parameter in parameters if parameter.name in BY_NAME}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            with self._lock:
                self._change(changes)
        except StavprError as error:
            self.get_logger().error(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:  # would end the process
            self.get_logger().error(traceback.format_exc())
            return SetParametersResult(successful=False, reason=f'{type(error).__name__}: {error}')
        return SetParametersResult(successful=True)

    def _change(self, changes: dict[str, Any]) -> None:
        old = self._settings
        fixed = [n for n, value in changes.items() if BY_NAME[n].when != 'live' and value != old.values[n]]
        if fixed and self._runtime is not None:
            raise SettingsError(
                f'{", ".join(fixed)} can be set only while the node is unconfigured, it is {self.state}: '
                'clean it up first (`ros2 lifecycle set NODE deactivate`, then cleanup)'
            )
        settings = node_settings({**old.values, **changes})
        if settings.save_path != old.save_path:
            _require_room(settings.save_path)
        if self._runtime is not None:
            if old.map_path and not settings.map_path:
                raise SettingsError(
                    "map_path = '' names no file: set the new map's, the old one stays until then"
                )
            self._runtime.change(settings)
        self._settings = settings
        self._apply_verbosity(settings.verbosity)

    def _on_parameters_set(self, parameters: list[Parameter]) -> None:
        """Tell what has become of the map; try to start again where the last try failed."""
        if self._runtime is not None:
            self.publish_map_info()
        elif self._start is not None and self.problem and self.state == 'unconfigured':
            self._start.reset()

    def load_again(self) -> None:
        """
        Load the map of ``map_path`` once more: the file may have changed.

        :raises StavprError: the node is not configured, or the map does not do; the old one stays.
        """
        with self._lock:
            self.runtime.load(self._settings.map_path)

    def _apply_verbosity(self, verbosity: str) -> None:
        """Log so much; what --log-level says of this node is not touched until a parameter says otherwise."""
        if verbosity != self._verbosity:
            level = LoggingSeverity.UNSET if verbosity == 'default' else LoggingSeverity[verbosity.upper()]
            self.get_logger().set_level(level)
        self._verbosity = verbosity

    # what is told

    def _on_clock_jump(self, jump: Any) -> None:
        runtime = self._runtime
        if runtime is not None:
            runtime.restart(f'the clock jumped back by {-jump.delta.nanoseconds / 1e9:.3f} s')

    def _health(self) -> Health:
        self.publish_map_info()
        counts = self.statistics.counts()
        return node_health(self.state, self.problem, self._settings, counts, self._runtime)

    def publish_map_info(self) -> None:
        """Publish ``~/map_info`` if it has changed."""
        with self._telling:
            runtime = self._runtime
            if runtime is not None:
                self._tell(runtime.map_info())

    def _tell(self, info: MapInfo) -> None:
        with self._telling:
            info.header.stamp = self.get_clock().now().to_msg()
            told, self._told = self._told, info
            if told is not None:
                told.header = info.header  # when it was told is no change
            if told != info and self.context.ok():
                self._map_info.publish(info)

    def destroy_node(self) -> None:
        """End the worker, say what was done, and take the node down."""
        self._diagnostics.stop()
        patience = 0.2 if self.ending.is_set() else PATIENCE + 1  # spin_until has waited before
        self.ending.set()
        # who holds the lock may be reading a large map, or compiling: nobody waits for that at the end
        if self._lock.acquire(timeout=patience):
            try:
                self._free()
            finally:
                self._lock.release()
        else:
            self.left_behind = True
            runtime = self._runtime
            if runtime is not None:
                runtime.write_at_the_end()
        if self.left_behind:
            self.get_logger().warning('something is still being loaded or compiled: it is left to itself')
        seen = self.statistics.counts()
        drops = ''.join(f', {count} {cause}' for cause, count in sorted(seen.drops.items()))
        self.get_logger().info(f'{seen.received} images received, {seen.answered} answered{drops}')
        super().destroy_node()


def _require_room(save_path: str) -> None:
    """Refuse a file that cannot be written before what has grown would be lost."""
    try:
        if save_path:
            require_room(save_path)
    except SourceError as error:
        raise SettingsError(f'save_path: {error}') from error
