# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mean centering: features without the part that all images of a traverse share."""

from dataclasses import replace

from stavpr_ros.features import LocalFeatures
import torch

PRIOR = 20  # images that the map's mean counts for in the running mean of the query
PIECE = 8192  # images centered at a time


class MeanCentering:
    """
    Subtracts means from features; unit norm again afterwards, zero features stay zero.

    :param features: those of the map, strips (W, n, d).
    """

    def __init__(self, features: LocalFeatures) -> None:
        self._mean = features.strips.sum(dim=1) / max(len(features), 1)  # (W, d)
        self.reset()

    def reset(self) -> None:
        """Drop the images of the query."""
        # float64: in float32, the images of a long traverse would be rounded away
        self._sum, self._count = self._mean.double() * PRIOR, PRIOR

    def places(self, features: LocalFeatures) -> LocalFeatures:
        """Return features of the map, or of single images, less the map's mean."""
        return replace(features, strips=without_mean(features.strips, self._mean))

    def next_query(self, strips: torch.Tensor) -> torch.Tensor:
        """
        Return the next image's features less the query's running mean, it included.

        :param strips: shape (W, d); the same is returned.
        """
        strips = strips.to(self._mean.device)
        self._sum = self._sum + strips
        self._count += 1
        return without_mean(strips[:, None], (self._sum / self._count).float())[:, 0]


def without_mean(strips: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
    """Return unit-norm (W, n, d) less (W, d); a piece of one strip after the other, for little memory."""
    out = torch.empty_like(strips, memory_format=torch.contiguous_format)
    for j in range(len(strips)):
        for whole, piece in zip(strips[j].split(PIECE), out[j].split(PIECE), strict=True):
            torch.sub(whole, mean[j], out=piece)
            piece.mul_(whole.any(dim=1, keepdim=True))
            piece.div_(piece.norm(dim=1, keepdim=True).clamp_(min=1e-12))
    return out
