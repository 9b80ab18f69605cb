# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The place filter in torch operations: its state stays on the device, one copy an image comes back.

An image is a linear map of the states a[k, v, y]: products with the probabilities that the level
and that the speed change, and a convolution along the places with the probabilities of steps of 0
to R places. No origins of states are kept, but the states from which each of the latest images
made the next ones: the origins of the few paths that are followed back follow from them::

    states    (K V, P + n), float32: P = lag R columns of zeros, then the places
    before    (lag, P + n, K, V): ring of the latest images; states after the change of level
    inputs    of an image, computed on the host; ``images`` (lag, size) is their ring
"""

from itertools import pairwise
from typing import Any

import numpy as np
from stavpr_ros import checks
from stavpr_ros.device_graph import DeviceGraph, HostCopy
from stavpr_ros.errors import SettingsError
from stavpr_ros.filter.kernels import speed_factors
from stavpr_ros.filter.model import FilterSettings, MODEL
from stavpr_ros.filter.paths import Belief, merged, NEGLIGIBLE, NO_PLACES, TOP
from stavpr_ros.filter.protocol import Filter
import torch
from torch.nn.functional import conv1d

COPIED = 512  # most probable places that are copied to the host
MAX_EXPONENT = 80.0  # its power is a finite float32 number
FAR = 1e30  # z of an excluded place: finite, so that 0 * z is 0


class DevicePlaceFilter(Filter):
    """
    A :class:`stavpr_ros.filter.place_filter.PlaceFilter` on a device of torch.

    Probabilities differ from those of the CPU in the last digits: sums are formed in another
    order. A place takes 120 bytes for each image of the lag and one more, with the default speeds
    and levels. Only the first question about an image waits for the device.

    :param places, lag, settings, gaps: see :class:`stavpr_ros.filter.place_filter.PlaceFilter`;
        every update is of all places.
    """

    def __init__(
        self,
        places: int,
        lag: int,
        settings: FilterSettings = MODEL,
        gaps: np.ndarray = NO_PLACES,
        device: torch.device | str = 'cuda',
    ) -> None:
        self.settings = s = settings
        self._device, self._shape = torch.device(device), (len(s.levels), len(s.speeds))
        self._speeds, self._levels, self._lag = np.array(s.speeds), np.array(s.levels), lag
        self._level_changes = s.level_changes()
        self._reach = int(np.ceil(self._speeds.max())) + 1  # R
        self._step_probabilities = (1 - s.leave) * np.array([1 - 2 * s.spread, s.spread, s.spread])
        gaps = gaps if places else np.zeros(1, np.int64)
        self._real = max(places - len(gaps), 1)
        self._not_near = NO_PLACES
        self._allocate(max(1, places), gaps)
        self._graph = DeviceGraph(self._device, self._advance)
        self.reset()

    def _allocate(self, n: int, gaps: np.ndarray) -> None:
        (K, V), R, lag, device = self._shape, self._reach, self._lag, self._device
        self._pad = pad = lag * R
        self._states = torch.zeros(K * V, pad + n, device=device)
        self._before = torch.zeros(lag, pad + n, K, V, device=device)
        self._z, self._floor, self._by_place = torch.zeros(3, n, device=device)
        self._gaps = torch.from_numpy(gaps).to(device) + pad
        self._outside = torch.cat([self._gaps, torch.arange(pad + n, pad + n + R, device=device)])
        self._shapes = {
            'slots': (lag,),  # of the ring, newest first
            'slope': (K, 1),  # alpha mu_k
            'offset': (K, 1),  # -alpha mu_k^2 / 2
            'floor': (1,),  # 0 where z of ``not_near`` counts as 0 at least, else -inf
            'entering': (K * V,),  # probability to come from off the map, of each state
            'levels': (K, K),  # factors of the level after, by the one before
            # of the speed after, by the one before: all, of the same, the one below, the one above
            'speeds': (V, 4, V),
            'taps': (K * V, 1, R + 1),  # probability of R, ..., 0 places
            'back': (V, 3),  # places of the speed's step, one more, one less
        }
        size = sum(int(np.prod(shape)) for shape in self._shapes.values())
        self._inputs = torch.zeros(size, device=device)
        self._images = torch.zeros(lag, size, device=device)
        self._sent = HostCopy(self._inputs)
        self._sent_parts = _parts(self._sent.numpy, self._shapes)
        self._rows = torch.arange(K * V, device=device).repeat(min(TOP, n))  # of states of places
        self._steps = torch.from_numpy(self._step_probabilities).float().to(device)
        self._speed_steps = torch.tensor([0, -1, 1], device=device)
        # sums of states on the map and of lost ones, by level; sums by place; places; states of
        # the first of them; their paths: V times the place of each image, newest first, plus the
        # speed; below 0 before the path entered the map
        copied, states = min(COPIED, n), len(self._rows)
        sizes = 2 * K, 2 * K, copied, copied, states, (lag + 1) * states
        self._out = torch.zeros(sum(sizes), dtype=torch.int32, device=device)
        self._received, self._ends = HostCopy(self._out), np.cumsum(sizes[:-1])

    def reset(self) -> None:
        """Forget where the camera was."""
        for tensor in (self._states, self._before, self._images, self._by_place):
            tensor.zero_()
        self._off = np.full(len(self._levels), 1 / len(self._levels))
        self._on_map, self._scale = np.zeros(len(self._levels)), 1.0
        self.count, self._is_read = 0, True

    def grow(self, places: int) -> None:
        """Reject places of a route: it is filtered on the CPU."""
        raise SettingsError("the filter of a device has one map: take backend 'cpu' for a route")

    def evict(self, count: int) -> None:
        """See :meth:`grow`."""
        self.grow(-count)

    def move_back(self, places: slice, count: int) -> None:
        """Move states back: :meth:`Filter.move_back`."""
        self._read()
        for values, pad in ((self._states.T, self._pad), (self._by_place, 0)):
            _move_back(values, places, count, pad)
        _move_back(self._before.transpose(0, 1), places, count, self._pad)

    def places_of_states(self) -> np.ndarray:
        """See :meth:`PlaceFilter.places_of_states`; copied from the device."""
        self._read()
        return self._by_place.cpu().numpy() * np.float32(self._scale)

    def update(
        self,
        z: torch.Tensor,
        weight: float,
        speed_weights: np.ndarray,
        speed_likelihoods: np.ndarray | None = None,
        not_near: np.ndarray = NO_PLACES,
    ) -> None:
        """See :meth:`PlaceFilter.update`; z is on the device, (n,)."""
        self._read()
        s, (K, V) = self.settings, self._shape
        checks.require_shape('z', z, f'{len(self._z) if len(z) else 0}')
        if not self.count:
            self._states[:, self._pad :] = s.start / (K * V * self._real)
            self._states.index_fill_(1, self._gaps, 0)
            self._off, self._on_map = np.full(K, (1 - s.start) / K), np.full(K, s.start / K)
        if len(not_near) and not np.array_equal(not_near, self._not_near):
            self._not_near = not_near
            self._floor.fill_(-torch.inf)[torch.from_numpy(not_near).to(self._device)] = 0
        self._z[: len(z)] = z
        self._off = self._off @ self._level_changes
        self._entering = (self._off * s.enter / (V * self._real)).astype(np.float32)
        levels = self._level_changes * np.float32(self._scale)
        self._on_map = self._on_map @ levels.astype(np.float64)
        sent = self._sent_parts
        sent['slots'][:] = (self.count - np.arange(self._lag)) % self._lag
        sent['slope'][:, 0] = weight * self._levels
        sent['offset'][:, 0] = -0.5 * weight * self._levels**2
        sent['floor'][:] = 0 if len(not_near) else -np.inf
        sent['entering'][:] = np.repeat(self._entering, V)
        steps = np.rint(self._speeds * (self.count + 1)) - np.rint(self._speeds * self.count)
        back = np.stack([steps, steps + 1, np.maximum(steps - 1, 0)], axis=1).astype(np.int64)
        taps = np.zeros((V, self._reach + 1), np.float32)
        for places, probability in zip(back.T, self._step_probabilities, strict=True):
            taps[np.arange(V), self._reach - places] += probability
        sent['taps'][:, 0], sent['back'][:] = np.tile(taps, (K, 1)), back
        if speed_likelihoods is None:
            speed_likelihoods = np.ones(V)
        weights = checks.relative_weights(V, speed_weights, speed_likelihoods)
        factors = speed_factors(*weights, s.keep_speed)
        speeds, v = sent['speeds'], np.arange(V)
        speeds[v, 1, v], speeds[v[1:], 2, v[:-1]] = factors[0], factors[1, 1:]
        speeds[v[:-1], 3, v[1:]] = factors[2, :-1]
        speeds[:, 0] = speeds[:, 1:].sum(axis=1) + np.outer(factors[3], factors[4])
        sent['levels'][:] = levels.T
        self._sent.send()
        self._graph()
        self._received.receive()
        self.count += 1
        self._is_read = False

    def _advance(self) -> None:
        """Advance the states by the inputs, and collect what the host reads."""
        (K, V), pad, n = self._shape, self._pad, len(self._z)
        part = _parts(self._inputs, self._shapes)
        slots = part['slots'].long()
        z = torch.maximum(self._z, self._floor + part['floor']).clamp_(max=FAR)
        likelihoods = torch.addcmul(part['offset'], part['slope'], z).clamp_(max=MAX_EXPONENT)
        likelihoods = likelihoods.exp_()[:, None]  # (K, 1, n)
        leveled = (part['levels'] @ self._states.view(K, -1)).view(K, V, -1)
        self._before.index_copy_(0, slots[:1], leveled.permute(2, 0, 1)[None])
        self._images.index_copy_(0, slots[:1], self._inputs[None])
        mixed = (part['speeds'][:, 0] @ leveled).view(1, K * V, -1)
        arrived = conv1d(mixed, part['taps'], part['entering'], padding=self._reach, groups=K * V)[
            0
        ]
        lost = arrived.index_select(1, self._outside).view(K, -1).sum(dim=1, dtype=torch.float64)
        states = self._states[:, pad:].unflatten(0, (K, V))
        torch.mul(arrived[:, pad : pad + n].unflatten(0, (K, V)), likelihoods, out=states)
        self._states.index_fill_(1, self._gaps, 0)
        by_level = states.sum(dim=1)
        torch.sum(by_level, dim=0, out=self._by_place)
        on_map = by_level.sum(dim=1, dtype=torch.float64)
        sums, places = self._by_place.topk(min(COPIED, n))
        top = places[:TOP] + pad
        results = on_map, lost, sums, self._states.index_select(1, top).T.reshape(-1)
        on_map, lost, sums, of_top = (each.view(torch.int32) for each in results)
        parts = on_map, lost, sums, places.int(), of_top, self._followed_back(slots, top)
        torch.cat(parts, out=self._out)

    def _followed_back(self, slots: torch.Tensor, top: torch.Tensor) -> torch.Tensor:
        """
        Return the paths to the m states of places, ((lag + 1) m,), int32.

        :param slots: of the ring, newest image first, and top: places, both int64.
        """
        (K, V), ring, rows = self._shape, self._before.view(-1, self._shape[1]), self._rows
        firsts = slots * (len(ring) // self._lag)  # row of the ring where each image begins
        part = _parts(self._images.index_select(0, slots), self._shapes)
        to_image = torch.diff(firsts, prepend=torch.zeros_like(firsts[:1]))
        jumps = to_image[:, None, None] - K * part['back'].long()  # rows of the ring
        at, speed = top.repeat_interleave(K * V) * K + rows // V, rows % V
        places, speeds, arrived = [], [speed], []
        for image in range(self._lag):
            origins = at[:, None] + jumps[image].index_select(0, speed)  # (m, 3)
            states = ring.index_select(0, origins.view(-1)).view(-1, 3, V)
            changes = part['speeds'][image].index_select(0, speed)
            mixed = changes @ states.transpose(1, 2)  # (m, 4, 3)
            by_step = mixed[:, 0] * self._steps
            step = by_step.argmax(dim=1, keepdim=True)
            change = mixed[:, 1:].argmax(dim=1).gather(1, step)[:, 0]
            at, speed = origins.gather(1, step)[:, 0], speed + self._speed_steps.take(change)
            places.append(at)
            speeds.append(speed)
            arrived.append(by_step)
        on_map = torch.stack(arrived).sum(dim=2) > part['entering'].index_select(1, rows)
        earlier = (torch.stack(places) - firsts[:, None]) // K - self._pad
        earlier = torch.where(on_map.cumprod(dim=0) > 0, earlier, -1)
        now = top.repeat_interleave(K * V)[None] - self._pad
        return (V * torch.cat([now, earlier]) + torch.stack(speeds)).int().view(-1)

    def _read(self) -> None:
        """Wait for the results of the latest image, once."""
        if self._is_read:
            return
        self._received.wait()
        s, V = self.settings, self._shape[1]
        on_map, lost, sums, self._top, states, paths = np.split(self._received.numpy, self._ends)
        on_map, lost = on_map.view(np.float64), lost.view(np.float64)
        entered = self._entering.astype(np.float64) * (V * len(self._outside))
        lost = (lost - entered) / (1 - s.leave)
        off = self._off * (1 - s.enter) + (self._on_map - lost) * s.leave + lost
        total = float(off.sum() + on_map.sum())
        self._off, self._on_map, self._scale = off / total, on_map.copy(), 1 / total
        self._top_sums = sums.view(np.float32) * self._scale
        self._top_states = states.view(np.float32) * self._scale
        self._paths = paths.reshape(self._lag + 1, -1)
        self._is_read = True

    def belief(self, n: int, images_ago: int) -> Belief:
        """See :meth:`PlaceFilter.belief`."""
        self._read()
        checks.require_indices('images_ago', images_ago, min(self._lag + 1, self.count))
        (K, V), then = self._shape, self._paths[images_ago]
        least = NEGLIGIBLE * self._top_states.max()
        rows = np.flatnonzero((self._top_states >= max(least, 1e-300)) & (then >= 0))
        now = rows % (K * V) // V, rows % V, self._top[rows // (K * V)]
        states = np.stack([then[rows] // V, *now, then[rows] % V], axis=1).astype(np.int64)
        return Belief(*merged(states, self._top_states[rows].astype(np.float64)))

    def most_probable(self, excluded: np.ndarray) -> tuple[int, float]:
        """See :meth:`PlaceFilter.most_probable`."""
        self._read()
        at = excluded.searchsorted(self._top)
        others = np.flatnonzero(np.append(excluded, -1)[at] != self._top)
        if len(others):
            return int(self._top[others[0]]), float(self._top_sums[others[0]])
        sums = self._by_place.index_fill(0, torch.from_numpy(excluded).to(self._device), 0)
        return int(sums.argmax()), float(sums.max()) * self._scale

    def path(self, state: np.ndarray, images: int) -> np.ndarray:
        """See :meth:`PlaceFilter.path`."""
        self._read()
        (K, V), (k, v, y) = self._shape, state[:3]
        column = (int(np.flatnonzero(self._top == y)[0]) * K + k) * V + v
        return self._paths[: images + 1, column] // V


def _move_back(values: torch.Tensor, places: slice, count: int, pad: int) -> None:
    """Add the values of places, (pad + n, ...), to those ``count`` places before."""
    moved = values[places.start + pad : places.stop + pad]
    values[places.start + pad - count : places.stop + pad - count] += moved
    moved.zero_()


def _parts(inputs: Any, shapes: dict[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return views of the parts of inputs, (..., size), by name; arrays or tensors."""
    ends = np.cumsum([0, *(np.prod(shape) for shape in shapes.values())]).tolist()
    return {
        name: inputs[..., first:end].reshape(*inputs.shape[:-1], *shape)
        for (name, shape), (first, end) in zip(shapes.items(), pairwise(ends), strict=True)
    }
