"""Knowing that other nodes have discovered ours."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

SETTLE_SECONDS = 2.0
"""How long a node may take to show its parameter service; some tools have none."""


@dataclass
class _Inquiry:
    """A request to another node: its answer proves that it has heard of our topics."""

    client: Client
    answer: Future | None = field(default=None)

    def done(self) -> bool:
        """Tell whether the answer is here, asking as soon as that is possible."""
        if self.answer is None and self.client.service_is_ready():
            self.answer = self.client.call_async(GetParameters.Request())
        return self.answer is not None and self.answer.done()


class Introduction:
    """
    Finds out when the nodes at the other end of our topics know of us; that we know of them is not enough.

    DDS does not tell when a remote endpoint has found ours. But discovery is told in order, and the
    topics of a request come after those made before it: a node that answers knows all. Nodes serve
    parameter requests by themselves; one that shows no such service is given ``SETTLE_SECONDS``.

    :param node: ours, with its publishers and subscriptions made; the caller spins it.
    :param endpoints: returns the endpoints at the other end, as ``get_publishers_info_by_topic`` does.
    :param timeout: seconds after which it is taken for done in any case.
    """

    def __init__(self, node: Node, endpoints: Callable[[], list[Any]], timeout: float) -> None:
        self._node = node
        self._endpoints = endpoints
        self._timeout = max(SETTLE_SECONDS, timeout)
        self._inquiries: dict[str, _Inquiry] = {}
        self._began: float | None = None

    def renew(self) -> None:
        """Ask everybody once more."""
        self._began = None
        for inquiry in self._inquiries.values():
            inquiry.answer = None

    def done(self) -> bool:
        """Tell whether everybody has answered; call it while spinning."""
        now = time.monotonic()
        self._began = now if self._began is None else self._began
        names = self._names()
        for name in names - self._inquiries.keys():
            client = self._node.create_client(GetParameters, f'{name}/get_parameters')
            self._inquiries[name] = _Inquiry(client)
        silent = [name for name in names if not self._inquiries[name].done()]
        if names and not silent:
            return True
        waited = now - self._began
        if waited > SETTLE_SECONDS and all(self._inquiries[name].answer is None for name in silent):
            return True
        return waited > self._timeout

    def _names(self) -> set[str]:
        """Full names of the nodes at the other end, as far as known by now."""
        return {
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in self._endpoints()
            if not info.node_name.startswith('_NODE_NAME_UNKNOWN')
        }
