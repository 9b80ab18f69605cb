"""Vertical strips of a feature map, the method's local features (section 1)."""

import torch

from stavpr_ros.errors import InputError


def cut_strips(feature_maps: torch.Tensor, W: int) -> torch.Tensor:
    """
    Cut feature maps into W vertical strips and flatten each.

    Of the r = Wf mod W columns that do not fit, floor(r / 2) are dropped on the left, the rest on the
    right; every strip is floor(Wf / W) columns wide.

    :param feature_maps: shape (n, C, H, Wf).
    :returns: strip-major local features, shape (W, n, C * H * floor(Wf / W)), float32, not normalized.
    :raises InputError: fewer columns than strips, or not four axes.
    """
    if feature_maps.ndim != 4:
        raise InputError(f'feature maps have shape {tuple(feature_maps.shape)}: expected (n, C, H, Wf)')
    n, channels, height, Wf = feature_maps.shape
    if not 1 <= W <= Wf:
        raise InputError(f'feature maps are Wf = {Wf} columns wide: they cannot be cut into W = {W} strips')
    width = Wf // W
    left = (Wf % W) // 2
    kept = feature_maps[..., left : left + W * width].float()
    strips = kept.reshape(n, channels, height, W, width).permute(3, 0, 1, 2, 4)
    return strips.reshape(W, n, channels * height * width)


def normalize(strips: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Split strips into directions and shares of the whole image's norm.

    :param strips: shape (W, n, d), float32.
    :returns: unit-norm strips (W, n, d), a zero strip stays zero (distance 1 to everything), and
        weights (W, n): norm of the strip / norm of all strips of its image, 0 for a black image.
    """
    norms = torch.linalg.vector_norm(strips, dim=2)
    whole = torch.linalg.vector_norm(norms, dim=0)
    unit = strips / torch.where(norms > 0, norms, 1)[:, :, None]
    return unit, norms / torch.where(whole > 0, whole, 1)
