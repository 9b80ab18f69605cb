# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure on CUDA and on the CPU; also in the simulator (test_cuda_kernels.py)."""

from dataclasses import replace

import numpy as np
from places import features_of
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.recognition import RecognizerSettings, route_features, Status
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.place_filter import PlaceFilter
from stavpr_ros.recognition.window import SequenceBuffer
from test_cuda_filter import assert_equal_answers, SMALL
import torch

W, D, LAP, LENGTH, EXCLUDE = 3, 16, 20, 6, 8
SMALLER = replace(SMALL, enter=0.1)


@pytest.fixture(scope='module')
def cuda_filter(cuda_runtime):
    """Return the module, with small blocks and rooms."""
    from stavpr_ros.alignment.cuda import dtw
    from stavpr_ros.alignment.cuda import place_filter as kernels
    from stavpr_ros.recognition import cuda_filter, cuda_matcher, loop_closer, place_filter

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, 'BLOCK', 8)
        patch.setattr(dtw, 'BLOCK', 8)
        patch.setattr(cuda_matcher, 'AT_ONCE', 4)
        patch.setattr(loop_closer, 'choose_backend', lambda backend: backend)
        patch.setattr(route_features, 'ROOM', 8)
        for module in (cuda_filter, place_filter):  # the simulator is slow
            patch.setattr(module, 'TOP', 6)
        yield cuda_filter


def test_filter_of_growing_places_equals_that_of_the_cpu(cuda_filter):
    """None at first, more, fewer, evicted ones, none again."""
    lag, room = 4, 0
    cpu, cuda = PlaceFilter(room, lag, SMALLER), cuda_filter.CudaPlaceFilter(room, lag, SMALLER)
    rng = np.random.default_rng(0)
    answered = 0
    for image, n in enumerate([0, 0, 1, 5, 6, 7, 8, 9, 9, 12, 10, 11, 9, 10, 11, 0, 0, 12, 13]):
        if n > room:
            room = n + 3
            cpu.grow(room)
            cuda.grow(room)
        if image == 12:  # three places are evicted
            cpu.evict(3)
            cuda.evict(3)
        z = rng.normal(size=n).astype(np.float32)
        if n > 4:
            z[n - 3] -= 4
        weights = rng.uniform(0.5, 1, len(SMALLER.speeds))
        cpu.update(z, 0.5, weights)
        cuda.update(torch.from_numpy(z).to(cuda._device), 0.5, weights)
        answered += assert_equal_answers(cuda, cpu, n, min(image, lag)) is not None
    assert answered > 6


def laps(count):
    """Return features of a route that passes ``LAP`` places again and again."""
    rng = np.random.default_rng(0)
    known = rng.standard_normal((W, LAP, D))
    strips = known[:, np.arange(count) % LAP] + 0.4 * rng.standard_normal((W, count, D))
    return features_of(strips + rng.standard_normal((W, 1, D)))


@pytest.mark.parametrize(
    ('precision', 'limit', 'settled'),
    [('float32', 34, 2000), ('int8', 30, 20)],
)
def test_loop_closer_on_device_equals_that_of_the_cpu(
    cuda_filter, monkeypatch, precision, limit, settled
):
    """Growing, whitened anew, settled, evicted; late matches, too."""
    monkeypatch.setattr(route_features, 'SETTLED', settled)
    features = laps(44)
    settings = RecognizerSettings(sequence=SequenceSettings(LENGTH), nms_radius=3, mode='robust')
    cpu, cuda = (
        LoopCloser(
            settings, EXCLUDE, features.settings, limit=limit, backend=backend, precision=precision
        )
        for backend in ('cpu', 'cuda')
    )
    matched = late = 0
    for i in range(len(features)):
        one, other = (closer.update(features[i : i + 1], 1 + i) for closer in (cuda, cpu))
        assert (one.status, one.window_stamps) == (other.status, other.window_stamps)
        assert (cuda.first, len(cuda)) == (cpu.first, len(cpu))
        if other.sequence is None:
            assert one.sequence is None
            continue
        matched += other.accepted
        assert np.percentile(np.abs(cuda.newest_row() - cpu.newest_row()), 90) < 2e-3
        assert one.probability == pytest.approx(other.probability, abs=2e-3)
        assert one.sequence.middle == other.sequence.middle
        if other.status is Status.MATCH:
            np.testing.assert_array_equal(one.path, other.path)
        assert (one.late is None) == (other.late is None)
        if other.late is not None:
            late += 1
            assert one.late.place_index == other.late.place_index
    assert late or precision != 'float32'
    assert matched > 10
    np.testing.assert_allclose(cuda.features().strips, cpu.features().strips, atol=1e-5)
    monkeypatch.setattr(SequenceBuffer, 'rows', None)  # a copy of the whole window
    places, row = np.arange(cuda.first, cuda.first + 5), cuda.newest_row()[:5]
    np.testing.assert_array_equal(cuda.window_columns(places)[-1], row)
    np.testing.assert_allclose(cuda.window_columns(places), cpu.window_columns(places), atol=0.02)
    cuda.reset()
    assert cuda.update(features[:1]).status is Status.WARMING_UP


def test_loop_closer_with_lm_dtw_and_route_on_device_equals_that_of_the_cpu(cuda_filter):
    features = laps(34)
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(LENGTH), nms_radius=3)
    closers = [
        LoopCloser(settings, EXCLUDE, features.settings, backend=b) for b in ('cpu', 'cuda')
    ]
    for i in range(len(features)):
        cpu, cuda = (closer.update(features[i : i + 1]) for closer in closers)
        assert cpu.status == cuda.status
        assert cpu.place_index == cuda.place_index
