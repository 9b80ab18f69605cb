# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Strips of a route that grows by one place at a time, on the CPU or on a CUDA device.

Strips are a tensor (W, room, d), float32, or one of the classes below, int8. All return
``strips[:, places]`` as float32 of unit norm.
"""

import numpy as np
from stavpr_ros.alignment.cpu.int8 import Int8Strips
import torch

PIECE = 256  # places rounded at a time


class Int8Route(Int8Strips):
    """Strips of a route in int8 on the CPU; see :class:`stavpr_ros.alignment.cpu.int8`."""

    def grow(self, room: int) -> None:
        """Make room for more places."""
        values, reciprocals = self.values, self.reciprocals
        super().__init__(self.shape[0], room, self.shape[2])
        self.values[:, : values.shape[1]] = values
        self.reciprocals[:, : reciprocals.shape[1]] = reciprocals

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for values, reciprocals in zip(
            self.values.view(np.int32)[..., 0], self.reciprocals, strict=True
        ):
            groups, quads, lanes = values.shape
            by_place = values.transpose(0, 2, 1).reshape(groups * lanes, quads)
            by_place[:-count] = by_place[count:].copy()
            values[:] = by_place.reshape(groups, lanes, quads).transpose(0, 2, 1)
            reciprocals[:-count] = reciprocals[count:].copy()


class DeviceInt8Route:
    """
    Strips of a route in int8 on a CUDA device, rounded as on the CPU.

    :param whole: the rounded strips, (W, room, d), int8.
    :param reciprocals: 1 / length of each rounded strip, (W, room), float32.
    """

    def __init__(self, W: int, places: int, d: int, device: torch.device) -> None:
        self.whole = torch.zeros((W, places, d), dtype=torch.int8, device=device)
        self.reciprocals = torch.zeros((W, places), device=device)

    @property
    def shape(self) -> torch.Size:
        """Return W, places that there is room for, and d."""
        return self.whole.shape

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: tuple[slice, slice | np.ndarray]) -> torch.Tensor:
        """Return strips of places, [:, places], float32, of unit norm again."""
        return self.whole[index].float() * self.reciprocals[index][..., None]

    def write(self, first: int, strips: torch.Tensor) -> None:
        """Round strips (W, m, d), float32, on the CPU, and keep them from place ``first`` on."""
        W, m, d = strips.shape
        rounded = Int8Strips(W, m, d)
        rounded.write(0, strips)
        places = slice(first, first + m)
        self.whole[:, places] = rounded.rounded().to(self.whole.device)
        lengths = torch.from_numpy(rounded.reciprocals[:, :m])
        self.reciprocals[:, places] = lengths.to(self.whole.device)

    def grow(self, room: int) -> None:
        """Make room for more places."""
        self.whole, self.reciprocals = grown(self.whole, room), grown(self.reciprocals, room)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for part in (self.whole, self.reciprocals):
            move_up(part, count, part.shape[1])


RouteStrips = torch.Tensor | Int8Route | DeviceInt8Route


def grown(values: torch.Tensor, room: int) -> torch.Tensor:
    """Return (W, n, ...) with room for more places; memory that is not used is not touched."""
    W, n, *rest = values.shape
    out = torch.empty((W, room, *rest), dtype=values.dtype, device=values.device)
    out[:, :n] = values
    return out


def move_up(values: torch.Tensor, count: int, last: int) -> None:
    """Move places ``count`` to ``last`` of (W, n, ...) up by ``count``."""
    for first in range(count, last, count):
        end = min(first + count, last)
        values[:, first - count : end - count] = values[:, first:end]


def rounded_strips(strips: torch.Tensor, count: int, on_device: bool) -> RouteStrips:
    """
    Return float32 strips (W, room, d), of which ``count`` places are known, in int8.

    :param on_device: of the kind that kernels of a CUDA device take.
    """
    W, room, d = strips.shape
    rounded: Int8Route | DeviceInt8Route = (
        DeviceInt8Route(W, room, d, strips.device) if on_device else Int8Route(W, room, d)
    )
    for low in range(0, count, PIECE):
        rounded.write(low, strips[:, low : min(low + PIECE, count)].cpu().contiguous())
    return rounded
