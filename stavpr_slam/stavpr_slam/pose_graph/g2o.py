# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pose graphs as g2o text, of the pose graph and of others.

The information of an edge has the translation first, and in three dimensions the rotation as the
vector of a quaternion, half of the rotation.
"""

from collections import Counter
import logging
from pathlib import Path

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.graph import GraphSettings, PoseGraph
from stavpr_slam.pose_graph.keyframes import ChainSettings
from stavpr_slam.pose_graph.transforms import adjoints, planar_poses, TRANSLATION_FIRST

HALF = np.diag([1.0, 1, 1, 2, 2, 2])
OUT_OF_PLANE = 1e4  # information of z, roll and pitch that a plane's edges are given
SIZES = {'EDGE_SE2': (3, 3), 'EDGE_SE3:QUAT': (7, 6)}  # numbers of a pose, of its information
NORM_ERROR = 0.1  # of a quaternion in text, of a few digits
ROUNDING = 1e-12  # of an eigenvalue, in parts of the greatest
INFORMATION = 1e-11, 1e15  # least and greatest eigenvalue: of 3e5 and 3e-8 m
GAP = 100 * SECOND  # between two sessions
Edge = tuple[int, int, np.ndarray, np.ndarray]  # start, end, motion (4, 4), information (6, 6)


def g2o_text(graph: PoseGraph) -> str:
    """Return the nodes as solved, the odometry and the accepted closures in the g2o format."""
    count = len(graph.solved)
    lines = ['# g2o: accepted closures only']
    poses = to_poses(graph.solved)
    lines += [f'VERTEX_SE3:QUAT {i} {_numbers(pose)}' for i, pose in enumerate(poses)]
    chain = graph.chain
    nodes = np.flatnonzero(chain.previous[:count] >= 0)
    before, T = chain.previous[nodes], chain.transforms
    scales = graph.scales[chain.robot[nodes]] if len(graph.scales) else np.ones(len(nodes))
    covariances = scales[:, None, None] ** 2 * chain.path_errors(nodes, before)
    motions = inverse(T[before]) @ T[nodes]
    for row in zip(before.tolist(), nodes.tolist(), motions, covariances, strict=True):
        lines.append(_edge_text(*row))
    closures = graph.scales.min(initial=1.0) ** 2 if graph.settings.measured else 1.0
    for edge in graph.used:
        covariance = closures * edge.covariance
        lines.append(_edge_text(edge.place, edge.query, edge.transform, covariance))
    return '\n'.join(lines) + '\n'


def _edge_text(start: int, end: int, transform: np.ndarray, covariance: np.ndarray) -> str:
    information = np.linalg.inv(covariance)[TRANSLATION_FIRST]
    upper = (HALF @ information @ HALF)[np.triu_indices(6)]
    return f'EDGE_SE3:QUAT {start} {end} {_numbers(to_poses(transform))} {_numbers(upper)}'


def _numbers(values: np.ndarray) -> str:
    return ' '.join(f'{value:.9g}' for value in values)


def read_edges(path: str) -> list[Edge]:
    """
    Read the edges of a file; those in the plane (SE2) become rigid motions.

    An information matrix that is not positive definite is replaced by the nearest one that is; a
    warning has their number.

    :returns: the information has the translation first, and whole rotations.
    :raises InputError: it cannot be read, has no edge, or a line is neither a vertex nor an edge
        of poses with numbers that can be computed with.
    """
    edges, counts = [], Counter[str]()
    try:
        lines = Path(path).read_text(encoding='utf-8-sig').splitlines()
    except OSError as error:
        raise InputError(f'{path}: {error}') from error
    except UnicodeDecodeError as error:
        raise InputError(f'{path} is no text ({error}): decompress or convert it') from error
    for number, line in enumerate(lines, 1):
        tag, *fields = line.split() or ['#']
        if tag.startswith(('VERTEX_SE', 'FIX', 'PARAMS', '#')):
            continue
        try:
            edges.append(_edge(tag, fields, counts))
        except (ValueError, InputError) as error:
            text = line.strip()[:60]
            raise InputError(f'{path}, line {number}: {error}, found {text!r}') from error
    if not edges:
        raise InputError(f'{path} has no edge: expected lines of {" or ".join(SIZES)}')
    if counts['indefinite']:
        logging.getLogger('stavpr_slam').warning(
            '%s: %d of %d information matrices are not positive definite: the nearest ones that '
            'are replace them', path, counts['indefinite'], len(edges),
        )  # fmt: skip
    return edges


def _edge(tag: str, fields: list[str], counts: Counter[str]) -> Edge:
    """Return the edge of a line; ValueError, InputError: none that can be computed with."""
    if tag not in SIZES:
        raise ValueError(
            f'{tag} is not read: expected VERTEX_SE2, VERTEX_SE3:QUAT, {" or ".join(SIZES)}'
        )
    pose, freedom = SIZES[tag]
    count = 2 + pose + freedom * (freedom + 1) // 2
    if len(fields) != count:
        raise ValueError(f'{tag} has {len(fields)} numbers: expected {count}')
    numbers = np.array(fields, np.float64)
    if not (finite := np.isfinite(numbers)).all():
        raise ValueError(f'{fields[finite.argmin()]} is not finite: correct or remove the line')
    start, end = int(fields[0]), int(fields[1])
    upper = np.zeros((freedom, freedom))
    upper[np.triu_indices(freedom)] = numbers[2 + pose :]
    own = upper + np.triu(upper, 1).T
    values, axes = np.linalg.eigh(own)
    most = float(values[-1])
    if not INFORMATION[0] <= most <= INFORMATION[1]:
        raise ValueError(
            f'the information matrix has eigenvalues of {values[0]:.3g} to {most:.3g}: expected '
            'the inverse of a covariance, its upper triangle by rows'
        )
    least = max(ROUNDING * most, INFORMATION[0])
    if values[0] < least:
        counts['indefinite'] += 1
        own = (axes * values.clip(least)) @ axes.T
    if freedom == 3:
        information, at = np.eye(6) * OUT_OF_PLANE, [0, 1, 5]
        information[np.ix_(at, at)] = own
        motion = planar_poses(numbers[None, 2:5])[0]
    else:
        information, motion = np.linalg.inv(HALF) @ own @ np.linalg.inv(HALF), numbers[2:9]
        norm = float(np.linalg.norm(motion[3:]))
        if abs(norm - 1) > NORM_ERROR:
            raise ValueError(f'a quaternion of norm {norm:.3g}: expected qx qy qz qw of norm 1')
    transform = matrices(normalize_pose(motion))
    if start == end and not np.allclose(transform, np.eye(4), atol=1e-6):
        raise ValueError(f'an edge with a motion from vertex {start} to itself')
    return start, end, transform, information


def reversed_edge(start: int, end: int, motion: np.ndarray, information: np.ndarray) -> Edge:
    """Return the same edge from its end to its start."""
    turn = adjoints(inverse(motion)[None])[0][TRANSLATION_FIRST]
    return end, start, inverse(motion), turn.T @ information @ turn


def graph_of(edges: list[Edge]) -> PoseGraph:
    """
    Return a pose graph of edges; it is not solved yet.

    Edges between a vertex and the next larger number are its odometry, with their information as
    given; all others, and second ones, are closures. Those from a vertex to itself, which state
    nothing, are left out. A node is at a second of its own; where the odometry is interrupted, a
    session begins.

    :raises InputError: no odometry, or a value is not finite.
    """
    edges = [edge for edge in edges if edge[0] != edge[1]]
    numbers = sorted({number for edge in edges for number in edge[:2]})
    node = {number: i for i, number in enumerate(numbers)}
    odometry: dict[int, Edge] = {}
    closures = []
    for start, end, motion, information in edges:
        edge = node[start], node[end], motion, information
        if edge[1] == edge[0] - 1 and edge[1] not in odometry:
            edge = reversed_edge(*edge)
        if edge[1] == edge[0] + 1 and edge[0] not in odometry:
            odometry[edge[0]] = edge
        else:
            closures.append(edge)
    if not odometry:
        raise InputError('no edge between two successive vertices: expected an odometry')
    settings = ChainSettings(distance=0.0, angle=0.0, max_gap=GAP / SECOND / 2, max_speed=np.inf)
    graph = PoseGraph(GraphSettings(settings, measured=True))
    stamps, stamp, pose, spread = list[int](), SECOND, np.eye(4), np.zeros((6, 6))
    for i in range(len(numbers)):
        if i and i - 1 not in odometry:
            stamp, pose, spread = stamp + GAP, np.eye(4), np.zeros((6, 6))
        elif i:
            motion, stated = odometry[i - 1][2:]
            stamp, pose = stamp + SECOND, pose @ motion
            turn, errors = adjoints(pose[None])[0], np.linalg.inv(stated)[TRANSLATION_FIRST]
            spread = spread + turn @ errors @ turn.T
        stamps.append(stamp)
        graph.add_odometry(stamp, to_poses(pose))
        graph.chain.spread[i] = spread
    for start, end, motion, information in closures:
        turn = np.kron(np.eye(2), motion[:3, :3])  # to the axes of the start
        covariance = turn @ np.linalg.inv(information) @ turn.T
        graph.add_closure(Closure(stamps[end], stamps[start], to_poses(motion), covariance))
    return graph
