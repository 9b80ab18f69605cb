# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks that other nodes have discovered this one."""

from collections.abc import Callable
import time
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

SERVICE_SECONDS = 2.0
"""Time in which a node shows its parameter service; some tools have none."""


class Discovery:
    """
    Finds out when the nodes at the other end of our topics have discovered us.

    A matched endpoint on our side does not imply a matched one on theirs, and DDS does not report
    it. But endpoints are announced in order, those of a request after those made before: a node
    that responds to a request has discovered our topics. Nodes serve parameter requests by
    default.

    :param node: ours, with its publishers and subscriptions made; the caller spins it.
    :param endpoints: returns the other endpoints, as ``get_publishers_info_by_topic`` does.
    :param timeout: seconds after which discovery counts as done.
    """

    def __init__(
        self, node: Node, endpoints: Callable[[], list[Any]], timeout: float = 10.0
    ) -> None:
        self._node, self._endpoints = node, endpoints
        self._timeout = max(SERVICE_SECONDS, timeout)
        self._clients: dict[str, Client] = {}
        self._responses: dict[str, Future] = {}
        self._start: float | None = None

    def restart(self) -> None:
        """Request new responses."""
        self._responses.clear()
        self._start = None

    def done(self) -> bool:
        """Return whether all nodes have responded, or need not; to be called while spinning."""
        if self._start is None:
            self._start = time.monotonic()
        names = self._names()
        for name in names - self._responses.keys():
            self._request(name)
        requested = [self._responses[name] for name in names if name in self._responses]
        waited = time.monotonic() - self._start
        if not all(response.done() for response in requested):
            return waited > self._timeout
        return (bool(names) and len(requested) == len(names)) or waited > SERVICE_SECONDS

    def _request(self, name: str) -> None:
        if name not in self._clients:
            self._clients[name] = self._node.create_client(GetParameters, f'{name}/get_parameters')
        if self._clients[name].service_is_ready():
            self._responses[name] = self._clients[name].call_async(GetParameters.Request())

    def _names(self) -> set[str]:
        """Return the full names of the nodes at the other end, as far as they are known."""
        return {
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in self._endpoints()
            if not info.node_name.startswith('_NODE_NAME_UNKNOWN')
        }
