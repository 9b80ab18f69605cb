"""The node's services; each answers with a reason when it cannot do what it is asked."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.rclpy_workarounds import repeat_responses

if TYPE_CHECKING:
    from stavpr_ros.ros.node import PlaceRecognitionNode
    from stavpr_ros.ros.runtime import Runtime


class Services:
    """
    Serves ``~/load_map``, ``~/save_map``, ``~/reset``, ``~/relocalize`` and ``~/set_operation``.

    They share a callback group of their own: while one takes its time, images and diagnostics go on.
    """

    def __init__(self, node: 'PlaceRecognitionNode') -> None:
        self._node = node
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, serve in (
            (LoadMap, 'load_map', self._load_map),
            (SaveMap, 'save_map', self._save_map),
            (Trigger, 'reset', self._reset),
            (Relocalize, 'relocalize', self._relocalize),
            (SetOperation, 'set_operation', self._set_operation),
        ):
            answer = self._with_reason(serve)
            repeat_responses(node.create_service(kind, f'~/{name}', answer, callback_group=group))

    def _with_reason(self, serve: Callable[['Runtime', Any, Any], str]) -> Callable[[Any, Any], Any]:
        """Turn errors into answers: ``success`` and ``message``."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.message = serve(self._node.runtime, request, response)
                response.success = True
            except StavprError as error:
                response.success, response.message = False, str(error)
                self._node.get_logger().warning(f'a service could not do as it was asked: {error}')
            except Exception as error:  # the worker was stopped, or an error of ours: the client must hear
                response.success, response.message = False, f'{type(error).__name__}: {error}'
                self._node.get_logger().error(f'a service failed: {response.message}')
            return response

        return answer

    def _set_parameter(self, name: str, value: str) -> None:
        """Set a parameter of the node, which does it: so the two ways to change something are one."""
        result = self._node.set_parameters([Parameter(name, value=value)])[0]
        if not result.successful:
            raise StavprError(result.reason)

    def _load_map(self, runtime: 'Runtime', request: Any, response: Any) -> str:
        if not request.path:
            raise StavprError("path = '' names no file: give the map's")
        if request.path == self._node.get_parameter('map_path').value:
            self._node.load_again()
        else:
            self._set_parameter('map_path', request.path)
        response.map = runtime.map_info()
        self._node.publish_map_info()
        return f'{response.map.places} places from {request.path}'

    def _save_map(self, runtime: 'Runtime', request: Any, response: Any) -> str:
        settings = self._node.settings
        path = request.path or settings.save_path or settings.map_path
        if not path:
            raise StavprError("path = '', and neither save_path nor map_path is set: name a file")
        response.places = runtime.save(path, request.overwrite)
        self._node.publish_map_info()
        return f'{response.places} places to {path}'

    def _reset(self, runtime: 'Runtime', request: Any, response: Any) -> str:
        runtime.reset()
        return 'the window is empty'

    def _relocalize(self, runtime: 'Runtime', request: Any, response: Any) -> str:
        count = request.count or self._node.get_parameter('candidates').value
        response.match, response.candidates = runtime.relocalize(count)
        return response.match.reason or f'place {response.match.place_index}'

    def _set_operation(self, runtime: 'Runtime', request: Any, response: Any) -> str:
        self._set_parameter('operation', request.operation)
        return f'operation {request.operation}'
