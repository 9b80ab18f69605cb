# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place filter of the method, on the CPU and on devices, against its equations in loops."""

from dataclasses import replace
from functools import partial
import math

import numba
import numpy as np
import pytest
from stavpr_ros.devices import why_no_cuda
from stavpr_ros.errors import InputError, SettingsError, StavprError
from stavpr_ros.method.filter import PlaceFilter, power, STEEPEST
from stavpr_ros.method.model import Model
from stavpr_ros.method.path import FAR
from stavpr_ros.threads import one_thread

pytestmark = pytest.mark.usefixtures('one_thread')
# Every probability large enough to matter
LIVELY = Model(change=0.3, spread=0.15, leave=0.07, enter=0.1)
FEW = replace(LIVELY, speeds=(0.0, 0.6, 2.5), level=-1.5, most=1.0, start=0.2)
ONE = replace(LIVELY, speeds=(1.0,), spread=0.0)
NO_SPANS = np.empty((0, 2), np.int64)
NAN, INF = float('nan'), float('inf')


@pytest.fixture(params=['arrays', 'cpu', 'cuda'][: 2 + (not why_no_cuda())])
def make(request, set_constants):
    """Return a function that makes a filter: of arrays, and of tensors on each device."""
    if request.param == 'arrays':
        return PlaceFilter
    module = pytest.importorskip('stavpr_ros.method.device', exc_type=ImportError)
    set_constants(module, PLACES_AT_ONCE=32)
    return partial(module.DevicePlaceFilter, device=request.param)


def as_z(one, z):
    """Return z as a filter takes it, on a device as an array or as a tensor."""
    if isinstance(one, PlaceFilter) or one.count % 2:
        return z
    return pytest.importorskip('torch').from_numpy(z).to(one._device)


class Oracle:
    """The equations of :mod:`stavpr_ros.method.filter`, in float64, all states of all images."""

    def __init__(self, width, model, gaps=()):
        self.m, self.width, self.gaps, self.images = model, width, set(gaps), []
        self.V, self.moves = len(model.speeds), []  # from w to v, r places on: their probability
        for w in range(self.V):
            low, rest = math.floor(model.speeds[w]), model.speeds[w] % 1
            for r, share in ((low, 1 - rest), (low + 1, rest)):
                for more, p in ((-1, model.spread), (0, 1 - 2 * model.spread), (1, model.spread)):
                    for v, q in ((w - 1, model.change / 2), (w + 1, model.change / 2)):
                        v = min(max(v, 0), self.V - 1)  # noqa: PLW2901
                        self.moves.append((w, v, r + more, (1 - model.leave) * share * p * q))
                    p *= (1 - model.leave) * share * (1 - model.change)  # noqa: PLW2901
                    self.moves.append((w, w, r + more, p))

    def update(self, z, weight=1.0):
        m, states, L = self.m, self.V * (len(z) - len(self.gaps)), np.zeros(self.width)
        for y in range(len(z)):
            if z[y] < INF and y not in self.gaps:
                exponent = m.level * min(float(z[y]), m.most) - m.level**2 / 2
                L[y] = math.exp(m.weight * weight * exponent)
        arrived = np.full((self.V, self.width), m.start / states)
        if self.images:
            a, off = self.images[-1][:2]
            arrived[:] = m.enter * off / states
            for w, v, r, p in self.moves:
                for y in range(max(-r, 0), min(self.width - r, self.width)):
                    arrived[v, y + r] += p * a[w, y]
        off = 1 - arrived[:, L > 0].sum()
        c = (arrived * L).sum() + off
        self.images.append((arrived * L / c, off / c, L / c, 1 / c, states))

    def by_place(self):
        return self.images[-1][0].sum(axis=0)

    def beliefs(self, count):
        b, elsewhere, out = np.ones((self.V, self.width)), 1.0, []
        for a, _, L, scale, states in self.images[: -count - 1 : -1]:
            out.append((a * b).sum(axis=0))
            after, elsewhere = b * L, elsewhere * scale
            b = np.full(b.shape, self.m.leave * elsewhere)
            for w, v, r, p in self.moves:
                for y in range(self.width):
                    is_on_map = 0 <= y + r < self.width and L[y + r] > 0
                    b[w, y] += p * (after[v, y + r] if is_on_map else elsewhere)
            elsewhere = (1 - self.m.enter) * elsewhere + self.m.enter * after.sum() / states
        return np.array(out[::-1])


def drive(rng, width, count, first=8.0, speed=1.0, banned=0.1):
    """Return z of images of a camera that moves along the columns, (count, width)."""
    z = rng.standard_normal((count, width)).astype(np.float32)
    z[rng.random(z.shape) < banned] = np.inf
    places = np.rint(first + speed * np.arange(count)).astype(int) % width
    z[np.arange(count), places] = -3.0
    return z


def dense(beliefs, width):
    out = np.zeros((len(beliefs.probabilities), max(width, *beliefs.columns + 1, 0)))
    out[:, beliefs.columns] = beliefs.probabilities
    return out[:, :width]


def answers(one, width, images):
    beliefs = dense(one.beliefs(images), width)
    return one.by_place()[:width], beliefs, one.z(np.arange(width), images)


def assert_same(one, other, width, images, atol=0.0):
    for x, y in zip(answers(one, width, images), answers(other, width, images), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


def lines(images, *speeds):
    return np.rint(np.outer(speeds, np.arange(images) - images // 2)).astype(np.int64)


# ------------------------------------------------ the equations


@pytest.mark.parametrize('model', [LIVELY, FEW, ONE, Model(), replace(FEW, enter=0.0)])
@pytest.mark.parametrize(('length', 'gaps'), [(9, ()), (2, (20, 21, 22, 23)), (16, (20,))])
def test_probabilities_equal_equations(make, model, length, gaps):
    """Also with excluded columns, images without evidence, more or fewer columns, full rings."""
    width = 32  # one block
    rng, gaps = np.random.default_rng(length), np.array(gaps, np.int64)
    one, plain = make(width, length, model, gaps), Oracle(width, model, gaps)
    for image, z in enumerate(drive(rng, width, 31)):
        n = width - (image % 4 == 3) * int(rng.integers(1, 9))
        weight = 0.0 if image % 5 == 4 else float(rng.uniform(0.3, 3))
        one.update(as_z(one, z[:n]), weight)
        plain.update(z[:n], weight)
        now, most = one.by_place(), min(image + 1, length)
        np.testing.assert_allclose(now, plain.by_place(), rtol=1e-4, atol=1e-7)
        assert now.sum() + plain.images[-1][1] == pytest.approx(1, abs=1e-5)
        for images in {1, most, max(most - 3, 1)} if image in (0, 1, 7, 8, 14, 22, 29, 30) else ():
            beliefs = one.beliefs(images)
            if len(beliefs.columns):  # else now all are improbable
                expected = plain.beliefs(images)
                np.testing.assert_allclose(dense(beliefs, width), expected, rtol=1e-3, atol=2e-6)


def test_worked_example(make):
    """Two columns, one speed of a place an image, no evidence."""
    one = make(2, 2, Model((1.0,), change=0, spread=0, leave=0.1, enter=0.2, start=0.5))
    for _ in range(2):
        one.update(np.zeros(2, np.float32), 0.0)
    # both entered with 0.2 * 0.5 / 2; the second also came from the first, 0.9 * 0.25
    np.testing.assert_allclose(one.by_place(), [0.05, 0.275], rtol=1e-6)
    # without evidence, later images change nothing
    np.testing.assert_allclose(one.beliefs(2).probabilities, [[0.25, 0.25], [0.05, 0.275]])


@pytest.mark.parametrize('seed', range(3))
def test_paths_in_a_wide_map_equal_equations(make, seed):
    """Only paths through probable blocks are followed; all other columns are improbable."""
    width, gaps, model = 400, np.arange(200, 207), Model()
    one, plain = make(width, 12, model, gaps), Oracle(width, model, gaps)
    rng = np.random.default_rng(seed)
    for z in drive(rng, width, 15, first=(30, 190, 385)[seed], speed=1.3):
        one.update(z)
        plain.update(z)
    result, expected = one.beliefs(12), plain.beliefs(12)
    assert 0 < len(result.columns) < width
    np.testing.assert_allclose(dense(result, width), expected, rtol=0, atol=5e-3)


@pytest.mark.parametrize('speeds', [tuple(0.25 * v for v in range(17)), (0.0, 16.0)])
def test_many_and_fast_speeds_follow_the_camera(make, speeds):
    one, places = make(2500, 12, Model(speeds)), 900 + speeds[-1] * np.arange(20)
    for z in drive(np.random.default_rng(2), 2500, 20, 900, speeds[-1], 0):
        one.update(np.where(z == -3, -6, z).astype(np.float32))
    beliefs = one.beliefs(12)
    result = beliefs.columns[beliefs.probabilities.argmax(axis=1)]
    np.testing.assert_array_equal(result, places[-12:])


def test_power_is_that_of_numpy_up_to_the_steepest():
    for limit, error in ((10.0, 5e-6), (STEEPEST, 7e-5)):
        x = np.linspace(-limit, limit, 2001, dtype=np.float32)
        np.testing.assert_allclose([power(i) for i in x], np.exp(x.astype(float)), rtol=error)
        x = x.astype(float)
        np.testing.assert_allclose([power(i, 8) for i in x], np.exp(x), rtol=1e-7)
    assert power(np.float32(500)) == power(np.float32(STEEPEST))
    assert power(np.float32(-500)) == power(np.float32(-STEEPEST))


def test_large_exponents_stay_finite(make):
    one, z = make(40, 3), np.zeros(40, np.float32)
    z[10] = -1e30
    for _ in range(4):
        one.update(z, 1e3)
    assert np.isfinite(one.by_place()).all()
    assert np.isfinite(one.beliefs(3).probabilities).all()
    assert one.by_place().argmax() == 10


def test_map_without_columns_and_images_without_any(make):
    for one, z in ((make(0, 3), np.empty(0, np.float32)), (make(9, 3), np.full(9, np.inf, 'f'))):
        for _ in range(4):
            one.update(z)
        np.testing.assert_array_equal(one.by_place(), np.zeros(len(z)))
        assert one.beliefs(3).probabilities.shape == (3, 0)
        assert one.best_straight(lines(3, 1), slice(3, 3), NO_SPANS)[0] == -np.inf


# ------------------------------------------------ distances and straight paths


def straight_of_loops(z, steps, columns):
    n, best = z.shape[1], (-INF, [])
    for v in range(len(steps)):
        for y in columns:
            values = []
            for i, at in enumerate(y + steps[v]):
                near = min((z[i, x] for x in (at - 1, at, at + 1) if 0 <= x < n), default=INF)
                values.append(float(near) if 0 <= at < n and near < INF else FAR)
            if -np.mean(values) > best[0]:
                best = -np.mean(values), np.clip(y + steps[v], 0, n - 1)
    return best


@pytest.mark.parametrize('width', [5, 130, 700])
@pytest.mark.parametrize('images', [1, 9])
def test_best_straight_and_z_equal_loops(make, width, images):
    """Also at the ends of the map, and where columns are not compared, two chunks of them."""
    one, z = make(width, 9), drive(np.random.default_rng(width), width, 23, width - 20.0)
    z[:, 290:560] = np.inf
    z[-2, 565:566] = z[-1, 585:586] = -20  # of a path from a column that is not compared
    for row in z:
        one.update(as_z(one, row[: width - 3]))
    z[:, width - 3 :] = np.inf
    z = z[-images:]
    for speeds in ((0.5, 1.0, 2.4), (1.0, 12.0, 20.0), (1.0,)):
        for low, end, excluded in [
            (0, width, []), (-9, width + 9, [[-5, 2], [width - 60, width + 5]]),
            (width // 3, width // 2, [[40, 45], [42, 60]]), (2, width, [[0, width - 2]]),
            (0, width, [[0, width]]),
        ]:  # fmt: skip
            spans, steps = np.array(excluded, np.int64).reshape(-1, 2), lines(images, *speeds)
            score, path = one.best_straight(steps, slice(low, end), spans)
            columns = set(range(max(low, 0), min(end, width)))
            columns = sorted(columns.difference(*(range(*pair) for pair in excluded)))
            expected, expected_path = straight_of_loops(z, steps, columns)
            assert score == pytest.approx(expected, abs=1e-5)
            if images > 1:  # else neighbors are as good
                np.testing.assert_array_equal(path, expected_path)
            if len(path):
                columns = path[:, None] // [1, 2]
                np.testing.assert_array_equal(one.z(path, images), z[:, path])
                expected = np.take_along_axis(z, columns, axis=1)
                np.testing.assert_array_equal(one.z(columns, images), expected)
                np.testing.assert_array_equal(one.z(columns[:, ::-1], images), expected[:, ::-1])


# ------------------------------------------------ other layouts of columns


@pytest.mark.parametrize('moment', [1, 2, 8, 20])
def test_states_move_back(make, moment):
    """Two equal laps become one: as of a filter of one lap."""
    z = drive(np.random.default_rng(moment), 100, 30, 30)
    z[:, 80:] = np.inf  # none goes on from one lap to the next
    one, other = make(200, 9), make(100, 9)
    for image, row in enumerate(z):
        one.update(np.tile(row, 2))
        other.update(row)
        if image + 1 == moment:
            one.move_back(slice(100, 200), 100)
            assert not one.by_place()[100:].any()
        laps = one.by_place().reshape(2, 100)
        np.testing.assert_allclose(laps.sum(axis=0), other.by_place(), rtol=1e-4, atol=1e-6)
        if image + 1 >= moment:
            result = dense(one.beliefs(min(image + 1, 9)), 200).reshape(-1, 2, 100).sum(axis=1)
            expected = dense(other.beliefs(min(image + 1, 9)), 100)
            np.testing.assert_allclose(result, expected, rtol=0, atol=5e-3)


def test_move_back_is_of_those_columns_alone(make):
    """Paths behind them go on; a block at their border is followed on both sides."""
    one, other = make(2000, 9), make(2000, 9)
    for z in drive(np.random.default_rng(0), 2000, 12, 1500, 0.33):
        one.update(z)
        other.update(z)
    one.move_back(slice(400, 500), 400)
    assert_same(one, other, 2000, 9, 1e-4)
    middle = int(one.by_place().argmax())
    one.move_back(slice(middle, 2000), 1000)
    now, beliefs = one.by_place(), one.beliefs(1)
    assert min(now[:1000].sum(), now[1000:].sum()) > 0.02
    assert dense(beliefs, 2000).sum() == pytest.approx(now.sum(), abs=0.01)


@pytest.mark.parametrize('moments', [(1,), (2, 9), (12, 13, 22)])
def test_grown_filter_equals_one_that_had_the_room(moments):
    one, other, n = PlaceFilter(60, 9), PlaceFilter(60 + 30 * len(moments), 9), 60
    for image, z in enumerate(drive(np.random.default_rng(0), 200, 30, 50)):
        one.update(z[:n])
        other.update(z[:n])
        if image + 1 in moments:
            n += 30
            one.grow(n)
        most = min(image + 1, 9)
        arguments = lines(most, 1, 2), slice(0, n), np.array([[40 + image, 60 + image]])
        assert one.best_straight(*arguments)[0] == other.best_straight(*arguments)[0]
        assert_same(one, other, n, most, 1e-4)


@pytest.mark.parametrize('moments', [(1,), (2, 9), (12, 13, 22)])
def test_filter_without_its_oldest_columns_equals_one_of_the_others(moments):
    gap, width = np.array([70]), 150
    one, other = PlaceFilter(width, 9, gaps=gap), PlaceFilter(width, 9, gaps=gap - 60)
    z, removed = drive(np.random.default_rng(0), width, 30, 72), 0
    z[:, :60] = np.inf  # columns that go; in the other filter, they follow the last ones
    for image, row in enumerate(z):
        one.update(np.roll(row, -removed))
        other.update(np.roll(row, -60))
        if image + 1 in moments:
            removed += 60 // len(moments)
            one.evict(60 // len(moments))
        result, expected = (answers(f, width, min(image + 1, 9)) for f in (one, other))
        for x, y in zip(result, expected, strict=True):
            np.testing.assert_allclose(np.roll(x, removed - 60, axis=-1), y, rtol=0, atol=1e-4)


def test_reset_filter_equals_a_new_one(make):
    rng, one = np.random.default_rng(0), make(80, 9)
    for count in (30, 12, 1):
        other = make(80, 9)
        one.reset()
        assert not one.by_place().any()
        for z in drive(rng, 80, count):
            one.update(z)
            other.update(z)
        assert_same(one, other, 80, min(count, 9))
    one.update(z)  # its results are not read
    one.reset()
    with pytest.raises(InputError, match='images = 1'):
        one.beliefs(1)


def test_threads_change_nothing():
    """Many threads that each compute a part, and one that computes all of them."""
    one, other = PlaceFilter(4000, 9), PlaceFilter(4000, 9)
    for z in drive(np.random.default_rng(0), 4000, 20, 1020):
        with one_thread():
            one.update(z)
        before = numba.get_num_threads()
        numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
        other.update(z)
        numba.set_num_threads(before)
    assert_same(one, other, 4000, 9)


# ------------------------------------------------ arguments that do not fit

N, L, Z = 100, 4, np.zeros(100, np.float32)
BAD = [np.where(np.arange(N) == 3, np.float32(value), Z) for value in (NAN, -INF)]


LINES, ALL = lines(4, 1, 2), slice(0, N)
WRONG_CALLS = [
    *(('update', z) for z in (np.zeros(N + 1, 'f'), np.zeros(10, 'f'), Z[None], Z.astype(int))),
    *(('update', z) for z in BAD),
    *(('update', Z, weight) for weight in (NAN, -0.1, INF, '0.3', None)),
    *(('beliefs', images) for images in (0, L + 1, -1, 1.5, NAN)),
    *(('z', np.array([y]), 1) for y in (-1, N, 0.5)), ('z', np.array([1]), L + 1),
    ('z', np.zeros((3, 2), int), 4), ('z', np.array([1]), 0), ('z', np.array(1), 1),
    *(('best_straight', steps, ALL, NO_SPANS) for steps in (
        LINES[::-1], lines(5, 1), LINES[:, :0], LINES[:0], LINES[0], LINES * 1.0)),
    *(('best_straight', LINES, ALL, spans) for spans in (NO_SPANS[0:0, 0], NO_SPANS * 0.5)),
    ('move_back', slice(10, 20), 15), ('move_back', slice(90, 110), 30),
    ('move_back', slice(50, 70), 10), ('move_back', slice(50, 60), 20.5),
    ('evict', N + 1), ('evict', -1), ('evict', 0.5), ('grow', N - 1), ('grow', N + 0.5),
]  # fmt: skip


@pytest.mark.parametrize('call', WRONG_CALLS)
def test_arguments_that_do_not_fit_are_an_error_and_change_nothing(make, call):
    """Kernels trust shapes: a column more than there is room for ends the process."""
    one, other = (make(N, L, gaps=np.array([10])) for _ in range(2))
    for z in drive(np.random.default_rng(0), N, 8, 20):
        one.update(z)
        other.update(z)
    with pytest.raises(StavprError):
        getattr(one, call[0])(*call[1:])
    one.update(Z)
    other.update(Z)
    assert_same(one, other, N, L)


def test_errors_name_what_came_and_what_was_expected(make, device):
    module = pytest.importorskip('stavpr_ros.method.device', exc_type=ImportError)
    of_device = module.DevicePlaceFilter(9, 3, device=device)
    for name, wrong in (('grow', 9), ('evict', 1)):
        with pytest.raises(SettingsError, match="backend 'cpu'"):
            getattr(of_device, name)(wrong)
    for shape in (10, (3, 3)):
        with pytest.raises(InputError, match='z'):
            of_device.update(module.torch.zeros(shape, device=device))
    one = make(N, L, gaps=np.array([9, 10]))
    one.update(Z)
    with pytest.raises(InputError, match='z of 4 places: expected 11 to 100'):
        one.update(np.zeros(4, np.float32))
    with pytest.raises(InputError, match='z has 1 NaN or -inf among 100'):
        one.update(BAD[0])
    with pytest.raises(SettingsError, match='weight = -1 must be at least 0'):
        one.update(Z, -1)
    with pytest.raises(InputError, match=r'images = 2: .* below 2'):
        one.beliefs(2)
    for wrong in (-1, L), (2.5, L), (N, 1), (N, L, Model(), np.array([5, 4])):
        with pytest.raises(StavprError):
            make(*wrong)


@pytest.mark.parametrize(('name', 'values'), {
    'speeds': [(), (0.0, NAN), (-1.0, 1.0), (1.0, 1.0), (17.0,), ('a',)],
    'level': [0.0, NAN, -INF], 'weight': [-1, NAN, '1'], 'most': [-1, INF],
    'leave': [0.0, 1.0, NAN], 'spread': [0.6, -0.1],
    **{name: [1.5, -0.1, NAN] for name in ('change', 'start', 'enter')},
}.items())  # fmt: skip
def test_numbers_that_are_no_model_are_rejected_by_name(name, values):
    for value in values:
        with pytest.raises(SettingsError, match=name):
            Model(**{name: value})
