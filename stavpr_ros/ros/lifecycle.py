"""A managed node that stands requests at any time: rclpy's would end the process at an impossible one."""

import threading
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn
from rclpy.node import Node

from stavpr_ros.ros.answers import wait_for_clients


class ManagedNode(LifecycleNodeMixin, Node):
    """
    A managed node whose state can be asked for while it changes, on another thread.

    :param name: of the node.
    """

    def __init__(self, name: str, **options: Any) -> None:
        Node.__init__(self, name, **options)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._transit = threading.Lock()  # one transition at a time
        self.ending = threading.Event()  # nobody waits for anything any more
        self.left_behind = False  # something was still under way when the node was destroyed
        service = self._service_change_state
        self._change_as_asked = service.callback
        service.callback = self._change_or_refuse
        for service in self.services:
            wait_for_clients(service)

    @property
    def state(self) -> str:
        """Label of the life-cycle state."""
        return str(self._state_machine.current_state[1])

    def advance(self, trigger: Callable[[], TransitionCallbackReturn]) -> bool:
        """
        Make a transition, such as ``trigger_configure``; tell whether it was made.

        One that the state does not have, or while another is under way, is not made, and that is said.
        """
        return self._guarded('this', lambda: trigger() == TransitionCallbackReturn.SUCCESS)

    def destroy_node(self) -> None:
        """
        Take the node down, and the services of its life cycle.

        rclpy leaves those to Python's collector, and until then others see them, and ask in vain.
        """
        if not self.left_behind:  # else a transition may still be under way
            self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def _change_or_refuse(self, request: Any, response: Any) -> Any:
        wish = request.transition.label or request.transition.id
        response.success = self._guarded(wish, lambda: self._change_as_asked(request, response).success)
        return response

    def _guarded(self, wish: str | int, change: Callable[[], bool]) -> bool:
        if not self._transit.acquire(blocking=False):
            self.get_logger().warning(f'transition {wish!r} refused: another is under way ({self.state})')
            return False
        try:
            return change()
        except rclpy_implementation.RCLError as error:
            self.get_logger().error(f'no transition {wish!r} from state {self.state}: {error}')
            return False
        finally:
            self._transit.release()
