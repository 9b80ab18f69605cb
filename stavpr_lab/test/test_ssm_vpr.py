# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SSM-VPR: golden cases, every step against plain loops, and a traverse."""

import numpy as np
import pytest
from stavpr_lab.evaluation.ssm_vpr import (
    cubes,
    learn_whitening,
    PcaWhitening,
    SpatialReranker,
    SsmVpr,
    SsmVprSettings,
)
from stavpr_ros.errors import InputError
import torch

SMALL = SsmVprSettings(large=3, large_dimension=10, small_dimension=12, neighbors=4, candidates=3)


def random_maps(n, C, side, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).random((n, C, side, side))).float()


def agreement(nearest, side, reach):
    """Count pairs in plain loops."""
    total = 0
    for i in range(side**2):
        for j in range(side**2):
            (y, x), (v, u) = divmod(i, side), divmod(j, side)
            if max(abs(y - v), abs(x - u)) > reach:
                continue
            (ty, tx), (tv, tu) = divmod(nearest[i], side), divmod(nearest[j], side)
            total += (ty - y, tx - x) == (tv - v, tu - u)
    return total


@pytest.mark.parametrize('seed', range(4))
def test_agreement_equals_plain_loops(seed):
    reranker = SpatialReranker(random_maps(3, 4, 8))
    side, rng = reranker.side, np.random.default_rng(seed)
    nearest = np.arange(side**2)[None].repeat(3, 0)
    nearest[1] = rng.integers(0, side**2, side**2)
    nearest[2, rng.random(side**2) < 0.4] = 5
    expected = [agreement(row, side, reranker.reach) for row in nearest]
    assert reranker.agreement(nearest).tolist() == expected


def test_cubes_equal_plain_loops():
    maps = random_maps(2, 3, 5)
    found = cubes(maps, 3)
    assert found.shape == (2, 9, 27)
    columns = maps / maps.norm(dim=1, keepdim=True)
    for n, y, x in np.ndindex(2, 3, 3):
        cells = [columns[n, :, y + dy, x + dx] for dy in range(3) for dx in range(3)]
        np.testing.assert_allclose(found[n, 3 * y + x], torch.cat(cells), atol=1e-6)
    with pytest.raises(InputError, match='at least 9 x 9'):
        cubes(maps, 9)


def test_whitening_has_unit_covariance():
    samples = torch.from_numpy(np.random.default_rng(0).standard_normal((200, 30)) * range(1, 31))
    white = PcaWhitening(samples.float(), 5)(samples.float())
    assert white.shape == (200, 5)
    np.testing.assert_allclose(np.cov(white.T), np.eye(5), atol=1e-3)


def test_candidates_equal_plain_loops():
    maps = random_maps(7, 4, 6)
    ssm = SsmVpr(maps, maps, SMALL)
    query = maps[4] + 0.02 * random_maps(1, 4, 6, seed=2)[0]
    whitening = learn_whitening(maps, 3, 10)
    places = [
        (i, cube) for i, one in enumerate(maps) for cube in whitening(cubes(one[None], 3)[0])
    ]
    votes = [0] * 7
    for own in whitening(cubes(query[None], 3)[0]):
        near = sorted(places, key=lambda place: float((place[1] - own).norm()))
        for image, _ in near[: SMALL.neighbors]:
            votes[image] += 1
    expected = sorted(range(7), key=lambda image: (-votes[image], image))[:3]
    assert ssm.candidates(query).tolist() == expected
    assert expected[0] == 4


def test_weights_of_last_answers_by_hand():
    """Answers 10 (score 1) and 20 (score .5): place 13 gets .4 * 12 / 15, place 21 half of it."""
    ssm = SsmVpr(random_maps(3, 4, 6), random_maps(3, 4, 6), SMALL)
    places = np.array([13, 21, 40])
    assert ssm.weights(places).tolist() == [1, 1, 1]
    ssm._answers.extend([(10, 1.0), (20, 0.5)])
    np.testing.assert_allclose(
        ssm.weights(places), [1 + 0.4 * 12 / 15, 1 + max(0.4 * 4 / 15, 0.2 * 14 / 15), 1]
    )


def test_traverse_is_recognized_with_frame_correlation():
    maps = random_maps(9, 6, 10)
    ssm = SsmVpr(maps, maps, SMALL)
    for i in range(9):
        noisy = maps[i] + 0.1 * random_maps(1, 6, 10, seed=10 + i)[0]
        places, scores = ssm.recognize(noisy, noisy)
        assert places[0] == i
        assert len(places) == len(scores) == 3
