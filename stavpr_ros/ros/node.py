"""The place-recognition node: subscribes, hands over, publishes."""

import traceback

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image
from std_msgs.msg import Float32, Int32

from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.devices import choose_backend, why_no_cuda
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.engine import Engine, EngineOptions
from stavpr_ros.ros.messages import blank_match, map_info_message
from stavpr_ros.ros.parameters import declare_parameters
from stavpr_ros.ros.worker import Worker
from stavpr_ros.threads import limit_threads

REPORT_PERIOD = 10.0  # seconds between repeated warnings


class PlaceRecognitionNode(Node):
    """
    Recognises where images were taken; publishes one ``~/match`` for each image on ``image``.

    :raises StavprError: parameters that cannot work together, or a backend that is not here.
    """

    def __init__(self, **options: object) -> None:
        super().__init__('stavpr', **options)
        values = declare_parameters(self)
        backend = choose_backend(values['backend'])
        reason = why_no_cuda() if values['backend'] == 'auto' else 'as asked for'
        self.get_logger().info(f'backend {backend} ({reason or "there is a device"})')
        self._engine = Engine(
            EngineOptions(
                spatial=SpatialSettings(
                    values['strategy'], values['sigma'], values['xi'] or None, values['vertical']
                ),
                sequence=SequenceSettings(values['sequence_length'], values['beta']),
                neighbourhood=values['neighbourhood'],
                mode=values['mode'],
                backend=backend,
                precision=values['precision'],
                model_path=values['model_path'],
            )
        )
        self._received = self._dropped = 0
        answers = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._match = self.create_publisher(PlaceMatch, '~/match', answers)
        self._place_index = self.create_publisher(Int32, '~/place_index', answers)
        self._distance = self.create_publisher(Float32, '~/distance', answers)
        self._map_info = self.create_publisher(MapInfo, '~/map_info', latched)
        self._worker = Worker(self._answer, values['queue_size'])
        self._worker.call(lambda: limit_threads(values['threads'])).result()
        self._start(values['map_path'], values['threshold'])
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_subscription(
            Image,
            'image',
            self._on_image,
            qos_profile_sensor_data,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _start(self, map_path: str, threshold: float) -> None:
        """Take over the two parameters that may come later; say what is missing."""
        self._engine.check_threshold(threshold)
        if threshold > 0:
            self._worker.call(lambda: self._engine.set_threshold(threshold)).result()
        if map_path:
            try:
                self._load(map_path)
            except StavprError as error:
                self.get_logger().error(str(error))
        if self._engine.missing:
            self.get_logger().warning(f'waiting, no match is published: {self._engine.missing}')

    def _load(self, path: str) -> None:
        place_map = self._worker.call(lambda: self._engine.load(path)).result()
        self._map_info.publish(map_info_message(place_map, path, self.get_clock().now().to_msg()))
        self.get_logger().info(
            f'map {path}: {len(place_map)} places, features {place_map.settings.kind}, '
            f'{place_map.settings.strips} strips of {place_map.features.strips.shape[2]} dimensions'
        )

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Apply what may change while the node runs: the map and the threshold; all of it or nothing."""
        changes = {parameter.name: parameter.value for parameter in parameters}
        try:
            threshold = changes.get('threshold')
            if threshold is not None:
                self._engine.check_threshold(threshold)
            if 'map_path' in changes:
                if not changes['map_path']:
                    raise StavprError(
                        "map_path = '' names no file: set the new map's, the old one stays until then"
                    )
                self._load(changes['map_path'])
            if threshold is not None:
                wish = threshold if threshold > 0 else None
                self._worker.call(lambda: self._engine.set_threshold(wish)).result()
        except StavprError as error:
            self.get_logger().error(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_image(self, message: Image) -> None:
        self._received += 1
        dropped = self._worker.put(message)
        if dropped is not None:
            self._dropped += 1
            reason = 'newer images came before its turn'
            self._match.publish(
                blank_match(dropped.header, PlaceMatch.DROPPED, reason, self._engine.threshold)
            )
            self.get_logger().warning(
                f'images come faster than they can be matched: {self._dropped} of {self._received} dropped',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def _answer(self, message: Image) -> None:
        """Answer one image, on the worker's thread."""
        try:
            answer = self._engine.process(message)
        except Exception as error:
            self._engine.invalid += 1
            self.get_logger().error(f'an image could not be matched: {traceback.format_exc()}')
            reason = f'internal error: {type(error).__name__}: {error}'
            answer = blank_match(message.header, PlaceMatch.INVALID_IMAGE, reason, self._engine.threshold)
        self._publish(answer)

    def _publish(self, answer: PlaceMatch) -> None:
        if answer.verdict == PlaceMatch.MATCH:
            self._place_index.publish(Int32(data=answer.place_index))
            self._distance.publish(Float32(data=answer.distance))
        elif answer.verdict == PlaceMatch.INVALID_IMAGE:
            self.get_logger().warning(
                f'image skipped ({self._engine.invalid} so far): {answer.reason}',
                throttle_duration_sec=REPORT_PERIOD,
            )
        elif answer.verdict == PlaceMatch.NOT_READY:
            self.get_logger().warning(
                f'images arrive, but no match is published: {answer.reason}',
                throttle_duration_sec=REPORT_PERIOD,
            )
        self._match.publish(answer)

    def destroy_node(self) -> None:
        """End the worker, say what was done, and take the node down."""
        self._worker.stop()
        self.get_logger().info(
            f'{self._received} images received, {self._dropped} dropped, {self._engine.invalid} invalid'
        )
        super().destroy_node()
