# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place-recognition node: its life cycle and its parameters."""

from collections.abc import Callable, Mapping
import gc
import sys
import threading
import traceback
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from stavpr_msgs.msg import MapInfo
from stavpr_ros.compilation import progress
from stavpr_ros.errors import left_out, SettingsError, StavprError
from stavpr_ros.memory import give_back
from stavpr_ros.parameters import BY_NAME, RENAMED
from stavpr_ros.pipeline import node_settings, NodeSettings
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros.diagnostics import publish_diagnostics
from stavpr_ros.ros.health import Health, INVALID
from stavpr_ros.ros.parameters import (
    convert_type,
    declare_parameters,
    inside_maps_folder,
    renaming_warning,
    require_changeable,
    require_writable,
    unknown_parameters,
)
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.runtime import Runtime
from stavpr_ros.ros.services import Services
from stavpr_ros.ros.worker import STOP_TIMEOUT
from stavpr_ros.units import SECOND

NAMESAKE_PERIOD = 60.0  # seconds between two warnings of another node with this name


class PlaceRecognitionNode(ManagedNode):
    """
    Recognizes the places of images; publishes one ``~/match`` for each image on ``image``.

    A lifecycle node: configuring loads the map and the model and compiles the kernels, activating
    subscribes, deactivating unsubscribes, cleaning up frees everything. With parameter
    ``autostart`` it configures and activates itself when it is spun. It needs an executor that
    runs services on ``THREADS`` threads.

    :raises StavprError: parameters that exclude each other, or a backend that is not available.
    """

    # a transition, loading, saving, another service and parameters may each take long
    THREADS = 6  # images take the last

    def __init__(self, **options: Any) -> None:
        self._lock = threading.RLock()  # one change of state, parameters or map at a time
        super().__init__('stavpr', **options)
        for warning in unknown_parameters(self.parameter_overrides):
            self.get_logger().warning(warning)
        progress.announce = self.get_logger().info
        self.settings = node_settings(declare_parameters(self))
        self._verbosity = 'default'
        self._apply_verbosity(self.settings.verbosity)
        self._runtime: Runtime | None = None
        self.statistics = Statistics()
        self.problem = ''  # why the last transition failed
        self._map_info: MapInfo | None = None  # the last one
        self._info_publisher = self.create_publisher(MapInfo, '~/map_info', LATCHED)
        self._info_lock = threading.RLock()
        Services(self, lambda: self.runtime, self.load_map, self.set_operation)
        self.add_on_set_parameters_callback(self._validate_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        backwards = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jumps = self.get_clock().create_jump_callback(
            backwards, post_callback=self._on_clock_jump
        )
        period = self.settings.diagnostics_period
        self._diagnostics = publish_diagnostics(self, period, self._health)
        self._start: Timer | None = None
        if self.settings.autostart:
            group = MutuallyExclusiveCallbackGroup()
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._start = self.create_timer(0.0, self._on_start, callback_group=group, clock=clock)

    @property
    def runtime(self) -> Runtime:
        """
        Return the runtime.

        :raises StavprError: the node is not configured.
        """
        if self._runtime is None:
            because = f' ({self.problem})' if self.problem else ''
            configure = 'configure it first, `ros2 lifecycle set NODE configure`'
            remedy = 'start it anew' if self.state == 'finalized' else configure
            raise StavprError(f'the node is {self.state}{because}: {remedy}')
        return self._runtime

    # life cycle

    def _on_start(self) -> None:
        """Configure and activate once; again only when a parameter was changed after a failure."""
        assert self._start is not None
        self._start.cancel()
        if self.state != 'unconfigured':
            return
        settings = self.settings
        if self.advance(self.trigger_configure):
            if not self.ending.is_set():
                self.advance(self.trigger_activate)
        elif self.state == 'unconfigured' and self.settings != settings:
            self._start.reset()  # a parameter was set during the failing transition

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load map and model, warm up the kernels, create the publishers."""
        return self._transition('configure', self._configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to images."""
        # publishers first: a match may be published as soon as there is a subscription
        publishers = super().on_activate
        return self._transition('activate', lambda: publishers(state), self._activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe from images, and save a recorded map."""
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
        """Run a transition; an error leads to the error state and is kept as the problem."""
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
        # a service may have changed the operation
        self.settings = settings = self._settings_with({})
        self.get_logger().info(settings.pipeline.backend_summary(settings.operation))
        require_writable(settings.save_path)
        if settings.map_path:
            self._publish_map_info('loading', settings.map_path)
        self._runtime = Runtime(self, settings, self.statistics, self._publish_map_info)
        extractor = self._runtime.pipeline.operation.extractor
        if extractor is not None and extractor.choice:
            self.get_logger().info(extractor.choice)
        if missing := self._runtime.pipeline.operation.missing:
            self.get_logger().warning(f'no image can be matched yet: {missing}')
        self._publish_map_info()
        # objects of the map and the model are permanent: scanning them again and again takes the
        # garbage collector half a second each time, during an image
        gc.collect()
        gc.freeze()
        give_back()

    def _activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.statistics.restart()
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
            if self._map_info is not None:
                self._publish_map_info('none')
        gc.unfreeze()
        # runtime and worker refer to each other: without it, the map would stay in memory
        gc.collect()
        give_back()
        if torch := sys.modules.get('torch'):
            torch.cuda.empty_cache()

    # parameters, map and operation

    def set_parameters(self, parameters: list[Parameter]) -> list[SetParametersResult]:
        """Set parameters one by one, one thread at a time: stored values are those in force."""
        with self._lock:
            return [self.set_parameters_atomically([parameter]) for parameter in parameters]

    def set_parameters_atomically(self, parameters: list[Parameter]) -> SetParametersResult:
        """Set parameters, all or none, one thread at a time."""
        for i, row in enumerate(parameters):
            if row.name in RENAMED:
                self.get_logger().warning(renaming_warning(row.name))
                parameters = [*parameters]
                parameters[i] = Parameter(RENAMED[row.name], value=row.value)
        try:
            if unknown := unknown_parameters(row.name for row in parameters):
                raise SettingsError('; '.join(unknown))
            with self._lock:
                folder = self.settings.maps_path
                rows = [inside_maps_folder(convert_type(row), self, folder) for row in parameters]
                return super().set_parameters_atomically(rows)
        except SettingsError as error:
            return self._reject(error)

    def load_map(self, path: str, verify: bool = False) -> None:
        """Load a map and use it, :meth:`stavpr_ros.ros.map_loading.MapLoader.load`."""
        self.runtime.load(path, self._lock, verify)

    def set_operation(self, operation: str) -> None:
        """Change the operation, :meth:`stavpr_ros.ros.runtime.Runtime.change`."""
        with self._lock:
            runtime, settings = self.runtime, self._settings_with({'operation': operation})
            runtime.change(settings)
            self.settings = settings
            self.get_logger().info(settings.pipeline.backend_summary(operation))
            self._publish_map_info()

    def _settings_with(self, changes: Mapping[str, Any]) -> NodeSettings:
        """Return the settings after a change of parameters; the operation in force stays."""
        values = {name: self.get_parameter(name).value for name in BY_NAME}
        if self._runtime is not None:
            values['operation'] = self.settings.operation
        return node_settings({**values, **changes})

    def _validate_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Check all parameters together; change nothing."""
        values = {row.name: row.value for row in parameters if row.name in BY_NAME}
        if not values:
            return SetParametersResult(successful=True)
        try:
            with self._lock:
                changes = {n: v for n, v in values.items() if v != self.get_parameter(n).value}
                if self._runtime is not None:
                    require_changeable(changes, self.state)
                settings = self._settings_with(changes)
                if settings.save_path != self.settings.save_path:
                    require_writable(settings.save_path)
        except StavprError as error:
            return self._reject(error)
        return SetParametersResult(successful=True)

    def _reject(self, error: StavprError) -> SetParametersResult:
        self.get_logger().error(f'parameters rejected: {error}')
        return SetParametersResult(successful=False, reason=str(error))

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Apply validated parameters; try to start again where the last try failed."""
        if not any(parameter.name in BY_NAME for parameter in parameters):
            return
        with self._lock:
            self.settings = self._settings_with({})
            self._apply_verbosity(self.settings.verbosity)
            if self._runtime is not None:
                try:
                    self._runtime.change(self.settings)
                except StavprError as error:  # the node ends
                    self.get_logger().error(f'parameters not applied: {error}')
                self._publish_map_info()
            elif self._start is not None and self.problem and self.state == 'unconfigured':
                self._start.reset()

    def _apply_verbosity(self, verbosity: str) -> None:
        """Set the log level; the level by --log-level stays until the parameter is changed."""
        if verbosity != self._verbosity:
            name = 'UNSET' if verbosity == 'default' else verbosity.upper()
            self.get_logger().set_level(LoggingSeverity[name])
        self._verbosity = verbosity

    def _on_clock_jump(self, jump: Any) -> None:
        if (runtime := self._runtime) is not None:
            runtime.restart(f'the clock jumped back by {-jump.delta.nanoseconds / SECOND:.3f} s')

    def _health(self) -> Health:
        self._publish_map_info()
        name, namespace = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count((name, namespace)) > 1:
            self.get_logger().warning(
                f'another node is named {self.get_fully_qualified_name()}, and its matches are on '
                'the same topics: end it (a killed one is gone after some seconds), or start this '
                'one in another namespace',
                throttle_duration_sec=NAMESAKE_PERIOD,
            )
        camera = self.resolve_topic_name('image')
        runtime = self._runtime
        parts = {} if runtime is None else runtime.state()
        parts['problem'] = self.problem or parts.get('problem', '')
        return Health(
            state=self.state,
            hardware_id=f'{self.settings.robot_id} {camera}'.lstrip(),
            settings=self.settings,
            counts=self.statistics.counts(),
            map_info=self._map_info or MapInfo(state='none'),
            **parts,
        )

    def _publish_map_info(self, state: str = '', path: str = '') -> None:
        """Publish the description of the map where it has changed; by a state, of none in use."""
        with self._info_lock:  # in the order of the changes
            if state:
                operation, robot_id = self.settings.operation, self.settings.robot_id
                info = MapInfo(operation=operation, state=state, path=path, robot_id=robot_id)
            elif (runtime := self._runtime) is not None:
                info = runtime.map_info()
            else:
                return
            info.header.stamp = self.get_clock().now().to_msg()
            last, self._map_info = self._map_info, info
            if last is not None:
                last.header = info.header  # a new stamp alone is no change
            if last != info and self.context.ok():
                self._info_publisher.publish(info)

    def destroy_node(self) -> None:
        """End the worker, save a recorded map, log the counts, and destroy the node."""
        self._diagnostics.stop()
        timeout = 0.2 if self.ending.is_set() else STOP_TIMEOUT + 1  # spin_until has waited before
        self.ending.set()
        # a thread that loads a large map or compiles may keep the lock: the end does not wait
        if self._lock.acquire(timeout=timeout):
            try:
                self._free()
            finally:
                self._lock.release()
        else:
            self.left_behind = True
            if (runtime := self._runtime) is not None:
                runtime.save_at_end()
        if self.left_behind:
            self.get_logger().warning('a thread is still loading or compiling: it is abandoned')
        counts = self.statistics.counts()
        drops = sorted(counts.dropped.total.items())
        losses = ''.join(f', {count} {cause}' for cause, count in drops)
        invalid = {k.removeprefix(INVALID): n for k, n in drops if k.startswith(INVALID)}
        if unread := left_out(invalid, {'odometry': counts.odometry_rejected}):
            self.get_logger().warning(unread)
        self.get_logger().info(
            f'{counts.received.count} images received, {counts.answered.count} processed{losses}'
        )
        super().destroy_node()
