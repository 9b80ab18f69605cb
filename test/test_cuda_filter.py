# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place filter on CUDA and that of the CPU; also in the simulator (test_cuda_kernels.py)."""

import numpy as np
from places import features_of, map_of
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.mapping import Session
from stavpr_ros.prepare.normalization import z_normalized
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
import torch

N, LAG = 37, 3
SMALL = FilterSettings(speeds=(0.0, 0.5, 1.0, 2.0, 4.5), levels=(-1.4, -3.4))


@pytest.fixture(scope='module')
def cuda_filter(cuda_runtime):
    """Return the module, with small blocks."""
    from stavpr_ros.alignment.cuda import place_filter as kernels
    from stavpr_ros.filter import cuda_filter, place_filter
    from stavpr_ros.recognition import recognizer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, 'BLOCK', 8)
        patch.setattr(recognizer, 'choose_backend', lambda backend: backend)
        for module in (cuda_filter, place_filter):  # the simulator is slow
            patch.setattr(module, 'TOP', 6)
        yield cuda_filter


def drive(count, gaps=()):
    """Rows of z of a drive over the end of the map, with the exponents and weights of images."""
    rng = np.random.default_rng(3)
    for image in range(count):
        z = rng.normal(size=N).astype(np.float32)
        place = 30 + image
        if place < N:
            z[place] -= 4
        z[image % 5] = np.inf
        z[list(gaps)] = np.inf
        speeds = rng.uniform(0.5, 1, (2, len(SMALL.speeds)))
        yield z, 0.0 if image == 6 else 0.3, *speeds


def assert_equal_answers(cuda, cpu, n, ago):
    """Compare filters of n places; return the middle of the most probable path, None = none."""
    found, expected = cuda.places_of_states(), cpu.places_of_states()
    np.testing.assert_allclose(found[:n], expected[:n], rtol=1e-3, atol=1e-7)
    assert not found[n:].any()
    one, other = cuda.belief(n, ago), cpu.belief(n, ago)
    np.testing.assert_array_equal(one.places, other.places)
    np.testing.assert_allclose(one.weights, other.weights, rtol=1e-3, atol=1e-7)
    if not len(other.places):
        return None
    top = np.argmax(other.weights)
    np.testing.assert_array_equal(one.states[top], other.states[top])
    path = cpu.path(other.states[top], ago)
    np.testing.assert_array_equal(cuda.path(one.states[top], ago), path)
    return path[0]


@pytest.mark.parametrize('gaps', [(), (11, 12, 13, 14)])
def test_update_and_answers_equal_those_of_the_cpu(cuda_filter, gaps):
    known = np.array(gaps, np.int64)
    cpu = PlaceFilter(N, LAG, SMALL, known)
    cuda = cuda_filter.CudaPlaceFilter(N, LAG, SMALL, known)
    for again in range(2):
        for image, (z, weight, *speeds) in enumerate(drive(11 - 8 * again, gaps)):
            cpu.update(z, weight, *speeds)
            cuda.update(torch.from_numpy(z).to(cuda._device), weight, *speeds)
            assert cuda.count == cpu.count == image + 1
            middle = assert_equal_answers(cuda, cpu, N, min(image, LAG))
            if middle is None:
                continue
            excluded = np.arange(max(0, middle - 5), min(N, middle + 6))
            place, probability = cpu.most_probable(excluded)
            found = cuda.most_probable(excluded)
            assert found[0] == place
            assert found[1] == pytest.approx(probability, rel=1e-3, abs=1e-9)
        cpu.reset()
        cuda.reset()
    assert cuda.most_probable(np.arange(N)) == (0, 0.0) or not cuda.count


def test_z_normalized_on_device_equals_that_of_the_cpu(cuda_filter):
    from stavpr_ros.recognition.cuda_windows import z_normalized_on_device

    row = np.random.default_rng(0).uniform(0.2, 1, 150).astype(np.float32)
    row[[7, 149]] = np.inf
    flat, banned = np.full(5, 0.5, np.float32), np.full(3, np.inf, np.float32)
    for values in (row, row[:5], flat, banned, row[:0]):
        for counted in (np.ones(len(values), bool), np.arange(len(values)) % 3 > 0):
            given = torch.from_numpy(values), torch.from_numpy(counted)
            found = z_normalized_on_device(*given)
            expected = z_normalized(values, counted=counted)
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(('sessions', 'precision'), [(False, 'int8'), (True, 'float32')])
def test_recognizer_in_mode_robust_equals_that_of_the_cpu(cuda_filter, sessions, precision):
    n, d, length = 24, 16, 6
    strips = np.random.default_rng(0).standard_normal((3, n, d))
    strips[:, 12:15] = strips[:, 11:12]  # the camera stood
    features = features_of(strips)
    place_map = map_of(features)
    if sessions:
        index = np.repeat(np.arange(2, dtype=np.int32), n // 2)
        same_as = np.arange(n, dtype=np.int32)
        same_as[15] = 2
        names = Session('a'), Session('b')
        place_map = map_of(features, sessions=names, session_index=index, same_as=same_as)
    settings = RecognizerSettings(sequence=SequenceSettings(length), nms_radius=3, mode='robust')
    cpu, cuda = (
        PlaceRecognizer(place_map, settings, backend, precision) for backend in ('cpu', 'cuda')
    )
    matched = 0
    for i in range(12):
        query = features[4 + i : 5 + i] if not sessions else features[i : i + 1]
        one, other = cuda.update(query, i), cpu.update(query, i)
        assert one.status == other.status
        assert one.window_stamps == other.window_stamps
        if other.sequence is None:
            continue
        matched += other.accepted
        assert one.probability == pytest.approx(other.probability, abs=1e-3)
        assert one.sequence.middle == other.sequence.middle
        assert one.sequence.second_best_index == other.sequence.second_best_index
        np.testing.assert_array_equal(one.path, other.path)
        assert [c.place for c in cuda.ranked(3)] == [c.place for c in cpu.ranked(3)]
        np.testing.assert_allclose(cuda.newest_row(), cpu.newest_row(), atol=1e-3)
    assert matched
