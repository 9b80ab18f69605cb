# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node; each returns the error as its message."""

from collections.abc import Callable
from dataclasses import replace
import os
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.errors import StavprError
from stavpr_ros.method import Match, Status
from stavpr_ros.pipeline.maps_folder import inside
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.saving import update_own_map, write_map
from stavpr_ros.ros.messages import (
    candidates_message,
    match_message,
    matched_pose_message,
    Outcome,
)
from stavpr_ros.ros.rclpy_workarounds import repeat_responses
from stavpr_ros.ros.runtime import Runtime
from std_msgs.msg import Header
from std_srvs.srv import Trigger

# waiting requests of each service: with the default, 10, requests of 50 clients were dropped
REQUESTS = QoSProfile(depth=1000)


class Services:
    """
    Serves ``~/load_map``, ``~/save_map``, ``~/reset``, ``~/relocalize`` and ``~/set_operation``.

    Loading and saving have callback groups of their own, the others share one: a long request
    delays neither images nor diagnostics, and a file that takes long no other service.

    :param runtime: returns the runtime; raises StavprError while the node is not configured.
    """

    def __init__(
        self,
        node: Node,
        runtime: Callable[[], Runtime],
        load_map: Callable[[str, bool], None],
        set_operation: Callable[[str], None],
    ) -> None:
        self._logger = node.get_logger()
        self._runtime, self._load, self._operate = runtime, load_map, set_operation
        self._faults: dict[str, str] = {}  # last fault of a service, until it succeeds
        loading, saving, others = (MutuallyExclusiveCallbackGroup() for _ in range(3))
        for kind, name, serve, group in (
            (LoadMap, 'load_map', self._load_map, loading),
            (SaveMap, 'save_map', self._save_map, saving),
            (Trigger, 'reset', self._reset, others),
            (Relocalize, 'relocalize', self._relocalize, others),
            (SetOperation, 'set_operation', self._set_operation, others),
        ):
            callback = self._callback(name, serve)
            service = node.create_service(
                kind, f'~/{name}', callback, qos_profile=REQUESTS, callback_group=group
            )
            repeat_responses(service)

    def _callback(
        self, name: str, serve: Callable[[Runtime, Any, Any], str]
    ) -> Callable[[Any, Any], Any]:
        """Return a callback that fills ``success`` and ``message``; logs a repeated error once."""

        def callback(request: Any, response: Any) -> Any:
            try:
                response.message = serve(self._runtime(), request, response)
                response.success = True
                self._faults.pop(name, None)
                return response
            except StavprError as error:
                log, response.message = self._logger.warning, str(error)
            except Exception as error:  # a defect: the client must get a response all the same
                log, response.message = self._logger.error, f'{type(error).__name__}: {error}'
            if self._faults.get(name) != response.message:
                log(f'{name} failed: {response.message} (logged once while it is repeated)')
            self._faults[name] = response.message
            response.success = False
            if name == 'relocalize':  # indices of -1, where the default 0 would be a place
                result = ImageResult(Match(Status.NOT_READY, response.message))
                response.match = match_message(
                    Outcome(Header(), result, robot_id=self._robot_id())
                )
            return response

        return callback

    def _robot_id(self) -> str:
        try:
            return self._runtime().settings.robot_id
        except StavprError:  # not configured: the parameter is not read
            return ''

    def _load_map(self, runtime: Runtime, request: Any, response: Any) -> str:
        if not request.path:
            raise StavprError("path = '' is no file: set the name of a map in the maps folder")
        path = inside(runtime.settings.maps_path, request.path)
        self._load(path, request.verify)
        response.map = runtime.map_info()
        return f'{response.map.places} places from {path}'

    def _save_map(self, runtime: Runtime, request: Any, response: Any) -> str:
        if runtime.updates_map and not request.path:
            log = self._logger
            response.places = update_own_map(runtime.pipeline, runtime.worker.run, log)
            path = runtime.pipeline.save_state.path
            if not response.places:
                raise StavprError(f'{path} stays as it is: the log has the reasons')
            return f'{response.places} places to {path}, which load_map reads'
        if request.path:
            path = inside(runtime.settings.maps_path, request.path)
        elif (
            file := runtime.settings.save_path or runtime.pipeline.save_state.path
        ) and not os.path.isdir(file):  # the maps of a folder are no file
            path = os.path.abspath(file)
        else:
            raise StavprError(
                "path = '', save_path is not set, and the map has no file: set a path"
            )
        response.places = write_map(runtime.pipeline, runtime.worker.run, path, request.overwrite)
        runtime.on_map_change()
        return f'{response.places} places to {path}'

    def _reset(self, runtime: Runtime, request: Any, response: Any) -> str:
        runtime.reset()
        return 'the window is empty'

    def _relocalize(self, runtime: Runtime, request: Any, response: Any) -> str:
        count = request.count or runtime.settings.pipeline.candidates

        def relocalize() -> None:
            # messages are made on the worker: a growing route may evict places before the next
            # call
            result = runtime.pipeline.operation.relocalize(count)
            assert runtime.last is not None
            response.match = match_message(runtime.last)
            outcome = replace(runtime.last, result=result)
            candidates, pose = candidates_message(outcome), matched_pose_message(outcome)
            response.candidates = candidates.candidates if candidates is not None else []
            response.has_pose = pose is not None
            response.pose = pose or response.pose

        runtime.worker.run(relocalize)
        return response.match.reason or f'place {response.match.newest_index}'

    def _set_operation(self, runtime: Runtime, request: Any, response: Any) -> str:
        self._operate(request.operation)
        return f'operation {request.operation}'
