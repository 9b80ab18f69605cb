# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Graphs of other programs: g2o files in two and three dimensions, with false closures."""

from motions import exponentials
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.commands.stavpr import main
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import blocks, tuning
from stavpr_slam.pose_graph.blocks import Blocks
from stavpr_slam.pose_graph.g2o import g2o_text, graph_of, read_edges, reversed_edge
from test_pose_graph import error

SIDE, LAPS = 12, 3
COUNT = 4 * SIDE * LAPS
INFORMATION = {
    3: [400, 0, 0, 400, 0, 3600],
    6: np.diag([400] * 3 + [14400] * 3)[np.triu_indices(6)],
}


def truth(freedom: int) -> np.ndarray:
    """Return laps of a square, one lap above the other in three dimensions, (COUNT, 4, 4)."""
    pose, poses = np.eye(4), []
    for i in range(COUNT):
        poses.append(pose.copy())
        turn = Rotation.from_euler('z', 90 * (i % SIDE == SIDE - 1), degrees=True)
        pose[:3, 3] += pose[:3, 0] + [0, 0, 0.05 * (freedom == 6)]
        pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
    return np.array(poses)


def write(path, freedom, false=0.0, stated=1.0):
    """
    Write a graph of noisy odometry and closures of later laps, a share of them false.

    :param stated: factor on the errors that the file states.
    """
    dice, T = np.random.default_rng(3), truth(freedom)
    pairs = [(i, i + 1) for i in range(COUNT - 1)]
    pairs += [(i - 4 * SIDE, i) for i in range(4 * SIDE, COUNT, 2)]
    deviations = np.array([0.017] * 3 + [0.05] * 3)
    if freedom == 3:
        deviations[[0, 1, 5]] = 0
    lines = ['PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1', 'FIX 0']
    information = np.array(INFORMATION[freedom]) / stated**2
    for start, end in pairs:
        place = end
        if end - start > 1 and dice.random() < false:
            place = (end + int(dice.integers(10, 4 * SIDE - 10))) % COUNT
        motion = (
            inverse(T[start]) @ T[place] @ exponentials(deviations * dice.normal(size=(1, 6)))[0]
        )
        pose, tag = to_poses(motion), 'EDGE_SE3:QUAT'
        if freedom == 3:
            pose, tag = (
                [*pose[:2], Rotation.from_matrix(motion[:3, :3]).as_rotvec()[2]],
                'EDGE_SE2',
            )
        lines.append(f'{tag} {start} {end} ' + ' '.join(map(str, [*pose, *information])))
    path.write_text('\n'.join(lines) + '\n')
    return str(path)


@pytest.mark.parametrize('freedom', [3, 6])
@pytest.mark.parametrize('false', [0.0, 0.5])
def test_closures_of_a_g2o_file_correct_its_odometry(tmp_path, freedom, false):
    graph = graph_of(read_edges(write(tmp_path / 'a.g2o', freedom, false)))
    odometry = to_poses(graph.chain.transforms)
    estimate = to_poses(graph.update(final=True))
    expected = to_poses(truth(freedom))
    assert error(estimate, expected) < 0.25 < 0.3 * error(odometry, expected)
    assert graph.accepted == pytest.approx(48 * (1 - false), abs=12 * false)


@pytest.mark.parametrize('stated', [60.0, 1 / 3])
@pytest.mark.parametrize('searched', [True, False])
def test_errors_that_a_file_states_wrong_are_recognized(tmp_path, monkeypatch, stated, searched):
    """At deviations of 3 m and a radian, false closures agree with a path that they bend."""
    if not searched:
        monkeypatch.setattr(tuning, 'FACTORS', np.ones(1))
    graph = graph_of(read_edges(write(tmp_path / 'a.g2o', 3, 0.5, stated)))
    estimate = to_poses(graph.update(final=True))
    right = error(estimate, to_poses(truth(3))) < 0.2 and graph.accepted == 21
    assert right == searched
    assert not searched or graph.scales[0] == pytest.approx(1 / stated, rel=0.5)


def test_closures_that_come_one_at_a_time_are_those_of_the_whole(tmp_path):
    edges = read_edges(write(tmp_path / 'a.g2o', 3, 0.5))
    whole = graph_of(edges)
    whole.update(final=True)
    odometry, closures = edges[: COUNT - 1], edges[COUNT - 1 :]
    graph = graph_of([*odometry, *closures[:12]])
    graph.update()
    for measurement in graph_of(edges)._pending[12:]:
        graph.add_closure(measurement)
        graph.update()
    assert [edge.accepted for edge in graph.edges] == [edge.accepted for edge in whole.edges]


@pytest.mark.parametrize(('freedom', 'stated'), [(6, 1.0), (3, 60.0)])
def test_written_graph_is_read_again(tmp_path, freedom, stated):
    graph = graph_of(read_edges(write(tmp_path / 'a.g2o', freedom, 0.3, stated)))
    graph.update(final=True)
    (tmp_path / 'b.g2o').write_text(g2o_text(graph))
    again = graph_of(read_edges(str(tmp_path / 'b.g2o')))
    estimate = again.update(final=True)
    assert (again.accepted, again.rejected) == (graph.accepted, 0)
    np.testing.assert_allclose(estimate[:, :3, 3], graph.solved[:, :3, 3], atol=0.05)


@pytest.mark.parametrize('freedom', [3, 6])
def test_vertices_with_gaps_and_edges_to_the_one_before(tmp_path, freedom):
    """As RTAB-Map exports its nodes."""
    edges = read_edges(write(tmp_path / 'a.g2o', freedom, 0.3))
    expected = graph_of(edges).update(final=True)
    changed = [
        reversed_edge(*edge) if number % 3 == 0 else edge for number, edge in enumerate(edges)
    ]
    numbers = np.cumsum(1 + np.arange(COUNT) % 4)
    renamed = [(int(numbers[i]), int(numbers[j]), *rest) for i, j, *rest in changed]
    estimate = graph_of(renamed).update(final=True)
    np.testing.assert_allclose(estimate, expected, atol=1e-6)


def edge(number, *diagonal, pose='1 0 0 0 0 0 1'):
    """Return an edge with these numbers on the diagonal of its information."""
    tag, size = ('EDGE_SE2', 5) if len(diagonal) == 3 else ('EDGE_SE3:QUAT', len(pose))
    information = np.diag(np.array(diagonal, object))[np.triu_indices(len(diagonal))]
    return ' '.join(map(str, [tag, number, number + 1, pose[:size], *information]))


SOUND = edge(0, 1, 1, 1)


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0', 'line 1: EDGE_SE2 has 10 numbers: expected 11'),
        (f'\n{SOUND} 1', 'line 2: EDGE_SE2 has 12 numbers'),
        ('EDGE_XY 0 1 1 0', 'line 1: EDGE_XY is not read: expected VERTEX_SE2'),
        (
            SOUND.replace('0 1', '0 2', 1) + '\n' + SOUND.replace('0 1', '1 3', 1),
            'no edge between',
        ),
        ('VERTEX_SE2 0 0 0 0', 'has no edge: expected lines of EDGE_SE2 or'),
        ('EDGE_SE2 0 1 1e9 0 0 1 0 0 1 0 1', 'line 1: pose .* is not finite: expected meters up'),
        (edge(0, -1, -1, -1), 'line 1: the information matrix has eigenvalues of -1 to -1: exp'),
        (edge(0, 0, 0, 0), 'the information matrix has eigenvalues of 0 to 0'),
        (edge(0, 1e200, 1, 1), 'the information matrix'),
        (edge(0, *[1] * 6, pose='1 0 0 0 0 0 0'), 'a quaternion of norm 0:'),
        (SOUND.replace('0 1', '0 0', 1), 'with a motion from vertex 0 to itself'),
        (SOUND.replace('0 1', 'nan 1', 1), 'line 1: nan is not finite'),
        *((edge(0, 1, 1, text), f'line 1: {text} is not') for text in ('-nan', 'inf', '1e999')),
        *((edge(0, *[1] * 5, text), f"'{text}'") for text in ('1.#INF', '1,5', '0x10')),
    ],
)
def test_graph_that_cannot_be_solved_is_named(tmp_path, text, words):
    (tmp_path / 'a.g2o').write_text(text + '\n')
    with pytest.raises(InputError, match=words):
        graph_of(read_edges(str(tmp_path / 'a.g2o')))


@pytest.mark.parametrize('text', [
    'EDGE_SE2 0 1 1 0 0 400 0 1500 400 0 3600', 'EDGE_SE2 0 1 1 0 0 1 1 0 1 0 1',
    edge(0, 4, 4, -4, 0, 0, 25), edge(0, 4, 4, 0, 0, 0, 25), edge(0, 1, -1, 1),
])  # fmt: skip
def test_information_that_is_not_definite_is_the_nearest_one_that_is(tmp_path, caplog, text):
    (tmp_path / 'a.g2o').write_text(f'{text}\n{edge(1, 1, 1, 1)}\n')
    edges = read_edges(str(tmp_path / 'a.g2o'))
    assert '1 of 2 information matrices are not positive definite' in caplog.text
    values = np.linalg.eigvalsh(edges[0][3])
    assert values[0] > 0
    graph = graph_of(edges)
    assert np.isfinite(graph.update(final=True)).all()


@pytest.mark.parametrize('freedom', [3, 6])
@pytest.mark.parametrize('missing', [[60], [50, 90]])
def test_odometry_that_is_interrupted_begins_a_session(tmp_path, freedom, missing, capsys):
    edges = read_edges(write(tmp_path / 'a.g2o', freedom, 0.3))
    graph = graph_of([edge for edge in edges if edge[1] != edge[0] + 1 or edge[0] not in missing])
    estimate = to_poses(graph.update(final=True))
    assert graph.chain.sessions == 1 + len(missing)
    assert error(estimate, to_poses(truth(freedom))) < 0.3
    lines = (tmp_path / 'a.g2o').read_text().splitlines(True)
    tags = tuple(f'EDGE_{kind} {i} {i + 1} ' for i in missing for kind in ('SE2', 'SE3:QUAT'))
    (tmp_path / 'a.g2o').write_text(''.join(line for line in lines if not line.startswith(tags)))
    assert main(['optimize_graph', str(tmp_path / 'a.g2o')]) == 0
    assert f'{1 + len(missing)} sessions: the odometry is inter' in capsys.readouterr().out


def test_session_that_only_a_later_one_joins(tmp_path):
    """Closures join the third lap to both others, which no closure joins."""
    edges, lap, T = read_edges(write(tmp_path / 'a.g2o', 3)), 4 * SIDE, truth(3)
    starts = lap - 1, 2 * lap - 1
    odometry = [edge for edge in edges if edge[1] == edge[0] + 1 and edge[0] not in starts]
    pairs = [(i, i % lap + 2 * lap) for i in range(0, 2 * lap, 2)]
    closures = [(i, j, inverse(T[i]) @ T[j], edges[-1][3]) for i, j in pairs]
    graph = graph_of([*odometry, *closures])
    assert error(to_poses(graph.update(final=True)), to_poses(T)) < 0.3
    assert (graph.chain.sessions, graph.rejected < 5) == (3, True)


@pytest.mark.parametrize('live', [False, True])
def test_graph_that_leaves_the_plane(live):
    """The first 60 nodes are in a plane, and are solved before the others come, or not."""
    T, information = truth(6), np.diag([400.0] * 3 + [3600.0] * 3)
    T[:, 2, 3] = np.maximum(T[:, 2, 3] - T[60, 2, 3], 0)
    ends = [(i, i + 1) for i in range(COUNT - 1)] + [(i, i + 48) for i in range(0, 96, 6)]
    edges = [(i, j, inverse(T[i]) @ T[j], information) for i, j in ends]
    graph = graph_of([edge for edge in edges if not live or edge[1] < 60])
    if live:
        graph.update()
        for i in range(60, COUNT):
            graph.add_odometry((i + 1) * SECOND, to_poses(T[i]))
        for measurement in graph_of(edges)._pending[2:]:
            graph.add_closure(measurement)
    assert error(to_poses(graph.update()), to_poses(T)) < 0.01
    assert (graph.accepted, graph.rejected) == (16, 0)


def test_file_that_is_no_text_is_named(tmp_path):
    (tmp_path / 'a.g2o').write_bytes(b'\x1f\x8b\x08\0')
    with pytest.raises(InputError, match=r'a\.g2o is no text .*: decompress or convert it'):
        read_edges(str(tmp_path / 'a.g2o'))


def test_byte_order_mark_line_ends_and_lines_that_state_nothing(tmp_path):
    lines = ['# comment', 'FIX 0', 'VERTEX_SE2 0 nan 0 0', '', SOUND, edge(1, 2, 2, 1e-3)]
    lines.append('EDGE_SE2 1 1 0 0 0 1 0 0 1 0 1')
    for end in ('\n', '\r\n', '\r'):
        (tmp_path / 'a.g2o').write_bytes(end.join(lines).encode('utf-8-sig'))
        graph = graph_of(read_edges(str(tmp_path / 'a.g2o')))
        assert (len(graph.chain), len(graph.edges)) == (3, 0)


def test_command_writes_the_solution(tmp_path, capsys):
    path = write(tmp_path / 'a.g2o', 3, 0.3)
    assert main(['optimize_graph', path, '--output', str(tmp_path / 'b.tum')]) == 0
    assert '144 poses, 48 closures' in capsys.readouterr().out
    poses = np.loadtxt(tmp_path / 'b.tum')[:, 1:]
    assert error(poses, to_poses(truth(3))) < 0.25
    assert main(['optimize_graph', str(tmp_path / 'missing.g2o')]) == 1


def test_map_merge_with_align_moves_poses_into_the_first_frame(small_map, tmp_path, map_file):
    shifted, both = load_map(map_file), str(tmp_path / 'both')
    shifted.poses[:, 1] += 5
    save_map(shifted, tmp_path / 'shifted')
    assert main(['map', 'merge', both, map_file, str(tmp_path / 'shifted'), '--align']) == 0
    poses = load_map(both).poses[60:]
    np.testing.assert_allclose(poses[:, :3], small_map.poses[:, :3], atol=0.5)


def test_false_closures_leave_the_odometry(tmp_path, capsys):
    path = write(tmp_path / 'a.g2o', 3, 1.0)
    assert main(['optimize_graph', path]) == 0
    assert 'the odometry stays' in capsys.readouterr().out


def test_edges_are_rigid_motions(tmp_path):
    (start, end, motion, information), *_ = read_edges(write(tmp_path / 'a.g2o', 6))
    assert (start, end) == (0, 1)
    assert motion.shape == (4, 4)
    np.testing.assert_allclose(np.diag(information), [400] * 3 + [3600] * 3)
    np.testing.assert_allclose(matrices(to_poses(motion)), motion)


def with_false(
    folder, name: str, share: float, group: int, seed: int, near: int = 0, alone: bool = False,
    first: str = 'right',
):  # fmt: skip
    """
    Return a graph of the papers with false closures, and how many of its closures are right.

    :param group: successive nodes of false closures with one motion.
    :param near: nodes that their ends are apart at most; 0 = any.
    :param alone: without the right ones.
    :param first: whether the right or the false ones are first in the file.
    """
    edges = read_edges(str(folder / f'pose_graphs/{name}.g2o'))
    right = [edge for edge in edges if edge[1] != edge[0] + 1]
    nodes, dice = max(edge[1] for edge in edges) + 1, np.random.default_rng(seed)
    count, false = round(len(right) * share / (1 - share)), []
    information = np.median([edge[3] for edge in right], axis=0)
    while len(false) < count:
        i, j = dice.integers(0, nodes - group, 2).tolist()
        if near:
            j = int(np.clip(i + dice.integers(-near, near), 0, nodes - group - 1))
        if abs(i - j) >= 3:
            motion = right[dice.integers(len(right))][2]
            made = range(min(group, count - len(false)))
            false += [(i + k, j + k, motion, information) for k in made]
    if alone:
        edges, right = [edge for edge in edges if edge[1] == edge[0] + 1], []
    return graph_of([*edges, *false] if first == 'right' else [*false, *edges]), len(right)


def keep(blocks, inliers, values):
    """Return closures as they are."""
    return inliers, values


CASES = {  # of a rule: a graph that is wrong without it, and what replaces the rule
    'certain closures first': ('MIT', 0.1, 10, 0, 0, tuning, 'CERTAIN', 0.0),
    'rejected ones that may agree by now': ('MIT', 0.3, 1, 2, 0, blocks, 'PASSES', (False,)),
    'improbable ones go': ('smallGrid3D', 0.5, 10, 1, 0, Blocks, '_drop_improbable', keep),
    'weak ones that leave for others': ('MIT', 0.1, 10, 0, 0, Blocks, '_swap_weak', keep),
    'closures of ten nodes count as one': (
        'MIT', 0.5, 10, 1, 40, blocks, 'weights_in_runs', lambda runs: np.ones(len(runs)),
    ),
    'certain together': ('MIT', 0.5, 1, 0, 0, blocks, 'are_certain', lambda odds, runs: False),
    'blocks by time': ('MIT', 0.5, 1, 0, 0, tuning, 'BLOCKS', 1),
    'four times the limit': ('parking-garage', 0.1, 1, 0, 0, tuning, 'TAILS', 1.0),
    'the factor on all errors': ('intel', 0.5, 10, 0, 0, tuning, 'FACTORS', np.ones(1)),
}  # fmt: skip


@pytest.mark.parametrize('rule', CASES)
def test_each_rule_of_blocks_has_a_graph_that_is_wrong_without_it(data_folder, monkeypatch, rule):
    name, share, group, seed, near, *replaced = CASES[rule]
    results = []
    for is_used in (True, False):
        if not is_used:
            monkeypatch.setattr(*replaced)
        graph, right = with_false(data_folder, name, share, group, seed, near)
        graph.update(final=True)
        accepted = np.array([edge.accepted for edge in graph.edges])
        results.append(accepted[:right].mean() - accepted[right:].sum())
    assert results[0] > 0.9
    assert results[1] < results[0]


@pytest.mark.parametrize('seed', [0, 1])
@pytest.mark.parametrize('share', [0.3, 0.5])
def test_false_closures_nearby_do_not_show_large_errors(data_folder, share, seed):
    """Alone, and in the first blocks, they fit a looser odometry than right closures do."""
    graph, right = with_false(data_folder, 'intel', share, 10, seed, near=40)
    graph.update(final=True)
    accepted = np.array([edge.accepted for edge in graph.edges])
    assert accepted[:right].mean() > 0.9
    assert accepted[right:].sum() < 5
    graph, _ = with_false(data_folder, 'intel', share, 10, seed, near=40, alone=True)
    graph.update(final=True)
    assert graph.accepted < 0.05 * graph.rejected


@pytest.mark.parametrize('name', ['MIT', 'smallGrid3D', 'intel'])
def test_order_of_the_closures_in_a_file_changes_nothing(data_folder, name):
    """False closures behind the right ones of a file, as tools append them, show no more."""
    accepted = []
    for first in ('right', 'false'):
        graph, right = with_false(data_folder, name, 0.5, 1, 0, first=first)
        graph.update(final=True)
        results = np.array([edge.accepted for edge in graph.edges])
        accepted.append(results if first == 'right' else np.roll(results, right))
    np.testing.assert_array_equal(*accepted)
