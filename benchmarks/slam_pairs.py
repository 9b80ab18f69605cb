# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The closures of a drive for the benchmark of the pose graph: recognition, then their edges."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import pickle
import time
from typing import Any, ClassVar

import numpy as np
from stavpr_lab.demonstration.street.laps import CAMERA_IN_BASE, intrinsics, LapDrive
from stavpr_lab.demonstration.street.traverses import SIZE
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.pipeline import Pipeline, PipelineSettings
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.landmarks import View
from stavpr_ros.relative_pose.pair import Edge, MatchedPair, Source
from stavpr_ros.sources.frame import ImageRecord
from stavpr_slam.pose_graph import Closure
from stavpr_slam.pose_graph.alignment import APPEARANCE, IDENTITY
from stavpr_slam.pose_graph.transforms import planar_poses

K = intrinsics()
CAMERA = Camera(*SIZE, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), '', (), tuple(CAMERA_IN_BASE))


@dataclass(frozen=True, eq=False)
class Matched:
    """A recognized pair: when it was known, and its images."""

    known: int
    query: int
    place: int
    pair: MatchedPair
    is_late: bool


@dataclass(frozen=True, eq=False)
class Found:
    """
    A closure: when it was known, the images of it, the pair, its edge, and the measurement.

    ``closure`` is None where PnP refuted the place: it is no edge of the graph.
    """

    known: int
    query: int
    place: int
    pair: MatchedPair
    edge: Edge
    closure: Closure | None
    seconds: float
    is_late: bool


class SharedViews(EdgeEstimator):
    """Keeps the views of all draws of a world: they do not depend on odometry."""

    views: ClassVar[dict[bytes, View | None]] = {}

    def _view_of(self, pair: MatchedPair, index: int, camera: Camera) -> View | None:
        key = pair.thumbnails[index]
        if key not in self.views:
            self.views[key] = super()._view_of(pair, index, camera)
        return self.views[key]


def recognize(
    drive: LapDrive,
    images: Sequence[np.ndarray] | np.ndarray,
    camera: Camera | None = CAMERA,
    exclude: int = 50,
) -> list[Matched]:
    """Recognize a drive and return its pairs."""
    own = [drive.images[:, 0] == lap for lap in range(drive.images[-1, 0] + 1)]
    laps = np.array([0, *np.cumsum([drive.images[lap, 1].max() + 1 for lap in own])])
    settings = PipelineSettings(backend='cpu', exclude_places=exclude, features='gradient')
    pipeline = Pipeline(settings, 'loop_closure')
    odometry, pairs = planar_poses(drive.odometry), []
    image_of = {int(stamp): i for i, stamp in enumerate(drive.stamps)}
    route: Any = None  # pairs without their map can be kept in a file
    for i, (lap, number) in enumerate(drive.images.tolist()):
        record = ImageRecord.of_image(images[laps[lap] + number], int(drive.stamps[i]))
        result = pipeline.operation.process(record, int(drive.stamps[i]), odometry[i], camera)
        for match in (result.match, *result.match.late):
            pair = pipeline.operation.matched_pair(match)
            if pair is None:
                continue
            query = image_of[match.window_stamps[match.position]]
            place = image_of[pair.source.place(match.place).stamp]
            pair = replace(pair, source=route)
            pairs.append(Matched(i, query, place, pair, match.is_late))
    return pairs


def recognized(drive: LapDrive, images: np.ndarray, path: Path) -> list[Matched]:
    """Return the pairs of a drive, recognized once: a file of this program keeps them."""
    if not path.exists():
        part = path.with_suffix('.part')
        part.write_bytes(pickle.dumps(recognize(drive, images)))
        part.replace(path)
    pairs: list[Matched] = pickle.loads(path.read_bytes())
    return pairs


def measured(pairs: list[Found]) -> list[Closure]:
    """Return the closures that are edges of the graph."""
    return [each.closure for each in pairs if each.closure is not None]


def with_edges(
    drive: LapDrive,
    pairs: list[Matched],
    estimator: EdgeEstimator,
    camera: Camera | None = CAMERA,
) -> list[Found]:
    """Return the closures of pairs, in their order."""
    closures = []
    for each in pairs:
        began = time.thread_time()
        edge = estimator.estimate(each.pair, camera, camera)
        took = time.thread_time() - began
        stamps = int(drive.stamps[each.query]), int(drive.stamps[each.place])
        pose = (edge.pose, edge.covariance) if edge.has_pose else (IDENTITY, APPEARANCE)
        closure = None
        if edge.source is not Source.REFUTED:
            closure = Closure(*stamps, *pose, edge.independent)
        closures.append(
            Found(each.known, each.query, each.place, each.pair, edge, closure, took, each.is_late)
        )
    return closures
