# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place filter on a CUDA device: its state stays there, one copy an image comes back."""

import numpy as np
from stavpr_ros.alignment.cuda.compilation import runtime
from stavpr_ros.filter.model import FilterSettings, MODEL
from stavpr_ros.filter.paths import ALL_ENTERED, Belief, belief_of, NEGLIGIBLE, NO_PLACES, TOP
from stavpr_ros.filter.protocol import Filter
import torch

MOST = 512  # most probable places that are copied to the host: more than are ever excluded


class CudaPlaceFilter(Filter):
    """
    A :class:`stavpr_ros.filter.place_filter.PlaceFilter` on torch's current CUDA device.

    Probabilities differ from those of the CPU in the last digits: sums are formed in another
    order. Only the first of :meth:`belief`, :meth:`most_probable` and :meth:`path` after an image
    waits for the device.
    """

    def __init__(
        self,
        places: int,
        lag: int,
        settings: FilterSettings = MODEL,
        gaps: np.ndarray = NO_PLACES,
    ) -> None:
        from stavpr_ros.alignment.cuda import place_filter

        self.settings = s = settings
        self._kernels, self._runtime = place_filter, runtime()
        self._device = device = self._runtime.torch_device
        self._shape, self._speeds = (len(s.levels), len(s.speeds)), np.array(s.speeds, np.float64)
        self._gaps = torch.from_numpy(gaps).to(device)
        self._reach, self._lag = int(np.ceil(self._speeds.max())) + 2, lag
        self._levels = torch.tensor(s.levels, dtype=torch.float32, device=device)
        self._level_changes = torch.from_numpy(s.level_changes()).to(device)
        self._allocate(places)
        self.reset()

    def _allocate(self, room: int) -> None:
        (K, V), lag, device = self._shape, self._lag, self._device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self._room = room = max(1, room)
        self._states, self._mixed = zeros(K * V, room), zeros(K * V, room)
        self._codes = zeros(K * V, room, dtype=torch.uint8)
        self._origins = zeros(lag, K * ((V + 1) // 2), room, dtype=torch.uint8)
        self._origins.fill_(ALL_ENTERED)
        self._steps = zeros(lag, V, dtype=torch.int32)
        self._sums = zeros(2 * K, room + self._reach)
        self._factors, self._entering = zeros(K, K), zeros(K)
        self._speed_factors, self._z = zeros(5, V), zeros(room)
        tops, top = min(TOP, room), min(MOST, room)
        # one buffer for the copy to the host: scale; places; their sums; states and their paths
        parts = (8, 8 * top, 4 * top, 4 * tops * K * V, 4 * (lag + 1) * tops * K * V)
        ends = np.cumsum([-(-size // 8) * 8 for size in parts]).tolist()
        types = (torch.float64, torch.int64, torch.float32, torch.float32, torch.int32)
        self._buffer = zeros(ends[-1], dtype=torch.uint8)
        self._host = self._runtime.host_buffer(ends[-1])
        self._out, on_host = (
            [
                buffer[start : start + size].view(dtype)
                for start, size, dtype in zip([0, *ends], parts, types, strict=False)
            ]
            for buffer in (self._buffer, self._host)
        )
        self._on_host = [part.numpy() for part in on_host]
        self._out[4] = self._out[4].view(lag + 1, -1)
        self._views = {
            name: self._runtime.array(getattr(self, name))
            for name in (
                *('_states', '_mixed', '_codes', '_sums', '_levels', '_factors', '_entering'),
                *('_speed_factors', '_z', '_origins', '_steps'),
            )
        }
        self._slots = [self._runtime.array(slot) for slot in self._origins]
        self._slot_steps = [self._runtime.array(slot) for slot in self._steps]
        self._copied = [self._runtime.array(part) for part in self._out]

    def reset(self) -> None:
        """Forget where the camera was."""
        self._states.zero_()
        self._sums.zero_()
        K = len(self.settings.levels)
        self._off = torch.full((K,), 1 / K, dtype=torch.float64, device=self._device)
        self._on_map = torch.zeros(K, dtype=torch.float64, device=self._device)
        self._scale = torch.ones((), dtype=torch.float64, device=self._device)
        self.count, self._read_at = 0, -1

    def places_of_states(self) -> np.ndarray:
        """See :meth:`PlaceFilter.places_of_states`; copied from the device."""
        found: np.ndarray = (self._by_place() * self._scale).float().cpu().numpy()
        return found

    def _by_place(self) -> torch.Tensor:
        return self._sums[: self._shape[0], : self._room].sum(dim=0)

    def _launch(self, kernel: object, count: int, *arguments: object) -> None:
        block = self._kernels.BLOCK
        self._runtime.launch(kernel, (-(-count // block), 1), block, *arguments)

    def update(
        self,
        z: torch.Tensor,
        weight: float,
        speed_weights: np.ndarray,
        speed_likelihoods: np.ndarray | float = 1.0,
        not_near: np.ndarray = NO_PLACES,
    ) -> None:
        """See :meth:`PlaceFilter.update`."""
        s, (K, V), v, n = self.settings, self._shape, self._views, len(z)
        slot = self.count % len(self._origins)
        moved = np.rint(self._speeds * (self.count + 1)) - np.rint(self._speeds * self.count)
        self._steps[slot].copy_(torch.from_numpy(moved.astype(np.int32)))
        real = max(n - len(self._gaps), 1)
        if not self.count and n:
            self._states[:, :n] = s.start / (K * V * real)
            self._states[:, self._gaps] = 0
            self._off.fill_((1 - s.start) / K)
            self._on_map.fill_(s.start / K)
        off = self._off @ self._level_changes.double()
        before = lost = self._on_map
        if n:
            self._z[:n] = z
            if len(not_near):
                raised = torch.from_numpy(not_near).to(self._device)
                self._z[raised] = self._z[raised].clamp(min=0)
            self._z[self._gaps] = -torch.inf
            changes = s.speed_changes(speed_weights, speed_likelihoods)
            self._speed_factors.copy_(torch.from_numpy(changes))
            self._factors.copy_(self._level_changes * self._scale.float())
            self._entering.copy_(off * s.enter / (V * real))
            before = self._on_map @ self._factors.double()
            self._launch(
                self._kernels.mix(K, V), n, n, v['_states'], v['_factors'], v['_speed_factors'],
                v['_mixed'], v['_codes'],
            )  # fmt: skip
            self._launch(
                self._kernels.move(K, V), n + self._reach, n, v['_mixed'], v['_codes'], v['_z'],
                self._slot_steps[slot], v['_levels'], np.float32(weight), np.float32(s.spread),
                np.float32(1 - s.leave), v['_entering'], v['_states'], self._slots[slot],
                v['_sums'],
            )  # fmt: skip
            sums = self._sums[:, : n + self._reach].sum(dim=1, dtype=torch.float64)
            self._on_map, lost = sums.view(2, K)
        off = off * (1 - s.enter) + (before - lost) * s.leave + lost
        total = off.sum() + self._on_map.sum()
        self._off, self._scale = off / total, 1 / total
        self.count += 1

    def _read(self) -> None:
        """Copy the most probable places, their states and paths to the host; once an image."""
        if self._read_at == self.count:
            return
        sums, places = torch.topk(self._by_place(), len(self._out[1]))
        for part, value in zip(self._out, (self._scale, places, sums), strict=False):
            part.copy_(value)
        newest = (self.count - 1) % len(self._origins)
        self._launch(
            self._kernels.trace(*self._shape), self._out[4].shape[1], self._copied[1],
            self._views['_states'], self._views['_origins'], self._views['_steps'], newest,
            self._copied[3], self._copied[4],
        )  # fmt: skip
        self._runtime.fetch(self._buffer, self._host)
        scale, self._top, top_sums, states, paths = self._on_host
        self._top_sums, self._top_states = top_sums * scale[0], states * scale[0]
        self._paths = paths.reshape(len(self._origins) + 1, -1)
        self._read_at = self.count

    def belief(self, n: int, images_ago: int) -> Belief:
        """See :meth:`PlaceFilter.belief`."""
        self._read()
        K, V = self._shape
        then = self._paths[images_ago]
        least = NEGLIGIBLE * self._top_states.max(initial=0)
        kept = np.flatnonzero((self._top_states >= max(least, 1e-300)) & (then >= 0))
        states = np.stack(
            [
                *(then[kept] // 16, kept % (K * V) // V, kept % V),
                *(self._top[kept // (K * V)], then[kept] % 16),
            ],
            axis=1,
        ).astype(np.int64)
        return belief_of(states, self._top_states[kept].astype(np.float64))

    def most_probable(self, excluded: np.ndarray) -> tuple[int, float]:
        """See :meth:`PlaceFilter.most_probable`."""
        self._read()
        left = np.flatnonzero(~np.isin(self._top, excluded))
        return (int(self._top[left[0]]), float(self._top_sums[left[0]])) if len(left) else (0, 0.0)

    def mean_z(self, state: np.ndarray) -> float:
        """See :meth:`Filter.mean_z`."""
        return self.settings.levels[state[0]]

    def speed(self, state: np.ndarray) -> float:
        """See :meth:`Filter.speed`."""
        return self.settings.speeds[state[3]]

    def path(self, state: np.ndarray, images: int) -> np.ndarray:
        """See :meth:`PlaceFilter.path`."""
        self._read()
        (K, V), (k, v, y) = self._shape, state[:3]
        column = (int(np.flatnonzero(self._top == y)[0]) * K + k) * V + v
        return self._paths[: images + 1, column] // 16
