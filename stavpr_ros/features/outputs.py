# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of a network to feature maps or vectors: tokens to maps."""

import math
from typing import Any

from stavpr_ros.errors import SettingsError


def as_maps(output: Any, images: int, prefix_tokens: int, name: str) -> Any:
    """
    Return what a network computes for a batch as feature maps or vectors.

    :param output: maps (n, C, H, Wf), vectors (n, D) or (n, D, 1, 1), or the tokens of a vision
        transformer (n, T, C), of square images; a NumPy array or a tensor.
    :param images: number n of images.
    :param prefix_tokens: leading tokens that are no patches.
    :param name: of the layer.
    :returns: maps or vectors, likewise.
    :raises SettingsError: another shape or type; tokens that are no square.
    """
    shape = tuple(getattr(output, 'shape', ()))
    if len(shape) not in (2, 3, 4) or shape[0] != images or 0 in shape:
        form = shape if shape else f'type {type(output).__name__}'
        raise SettingsError(
            f'{name} returns {form} for {images} images: expected maps (n, C, H, W), tokens '
            '(n, T, C) or vectors (n, D); name another layer'
        )
    if shape[2:] == (1, 1):  # of a pooling over the whole map
        return output[:, :, 0, 0]
    if len(shape) != 3:
        return output
    n, T, C = shape
    side = math.isqrt(max(T - prefix_tokens, 0))
    if side < 1 or side**2 != T - prefix_tokens:
        largest = math.isqrt(T)
        raise SettingsError(
            f'{name} returns {T} tokens, {T - prefix_tokens} without the first {prefix_tokens}: '
            f'expected those of a square; prefix_tokens = {T - largest**2} leaves {largest} x '
            f'{largest}'
        )
    return output[:, prefix_tokens:].swapaxes(1, 2).reshape(n, C, side, side)
