# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features of any network in a TorchScript file: its output or that of an inner layer.

A TorchScript file is a program that torch interprets. It holds no Python, but a malicious one may
reach files through torch's operators: it runs only with permission, after its hash was checked.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.outputs import as_maps, as_vectors, one_of
from stavpr_ros.features.preprocessing import BatchMaker
from stavpr_ros.features.registry import TorchScriptSettings
from stavpr_ros.features.weights import expected_hash, last_line, read_model
import torch


class TorchScript:
    """Feature maps or vectors of a network, float32 (float16 with ``half`` on a GPU)."""

    def __init__(self, settings: TorchScriptSettings, device: str = 'cpu') -> None:
        self._device = torch.device(device)
        path = Path(settings.model)
        if not settings.allow:
            raise SettingsError(
                f'the TorchScript file {path} is a program, which may read and write files: set '
                'parameter allow_torchscript (--torchscript-allow true) if you trust its source'
            )
        file, digest = read_model(path, expected_hash(path), settings.sha256)
        with file:
            try:
                network = torch.jit.load(file, map_location=self._device).eval()
            except Exception as error:  # damaged files raise errors of any type
                raise UnavailableError(
                    f'{path} is no usable TorchScript file: {last_line(error)}'
                ) from error
        self.settings = replace(settings, sha256=digest)
        half = settings.half and self._device.type == 'cuda'
        dtype = torch.float16 if half else torch.float32
        network = network.to(dtype)
        layer = settings.layer
        self._maps = up_to_module(network, layer, settings.model) if layer else network
        self._batch = BatchMaker(
            settings.size,
            settings.resize,
            self._device,
            dtype,
            scale=settings.scale,
            mean=settings.mean,
            std=settings.std,
            bgr=settings.channels == 'bgr',
        )

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Compute the feature maps of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: maps (n, C, H, Wf) or vectors (n, D), float32, or float16 with ``half`` on a GPU.
        :raises SettingsError: the network rejects the batch, or the layer returns neither maps nor
            tokens nor vectors.
        """
        return self._chosen(self._run(images), len(images))

    def maps_and_vectors(self, images: Sequence[np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Compute feature maps, see :meth:`feature_maps`, and vectors (n, D) of output ``vector``.

        :raises SettingsError: likewise; that output is no vector.
        """
        output, which = self._run(images), self.settings.vector
        vectors = one_of(output, which, self._name)
        name = f'output {which!r} of {self.settings.model}'
        return self._chosen(output, len(images)), as_vectors(vectors, len(images), name)

    @property
    def _name(self) -> str:
        return f'layer {self.settings.layer!r} of {self.settings.model}'

    def _chosen(self, output: Any, images: int) -> torch.Tensor:
        maps = one_of(output, self.settings.output, self._name)
        return as_maps(maps, images, self.settings.prefix_tokens, self._name)

    def _run(self, images: Sequence[np.ndarray]) -> Any:
        settings = self.settings
        try:
            with torch.inference_mode():
                return self._maps(self._batch(images))
        except Exception as error:  # operators have exception types of their own
            raise SettingsError(
                f'{settings.model} rejects {len(images)} images of size {settings.size}: '
                f'{last_line(error)}'
            ) from error


def up_to_module(
    network: torch.jit.ScriptModule, layer: str, name: str
) -> Callable[[torch.Tensor], Any]:
    """
    Return a function from images to the output of an inner module; nothing after it is computed.

    :param layer: path of the module, such as ``features.23``; of several calls, the last counts.
    :raises SettingsError: no such module, or it is called in a branch or loop, or not at all.
    """
    modules = [path for path, _ in network.named_modules() if path]
    if layer not in modules:
        shown = (
            ', '.join(modules[:60]) + (', ...' if len(modules) > 60 else '') if modules else 'none'
        )
        raise SettingsError(f'{name} has no layer {layer!r}: its layers are {shown}')
    cuts: list[tuple[_Cut, Any]] = []  # and the module whose program is cut
    module, method = network._c, 'forward'
    rest = layer.split('.')
    while rest:
        cut = _before_call(module._get_method(method).graph.copy(), rest)
        if cut is None:
            raise SettingsError(
                f'{name} has the layer {layer!r}, but calls it in a branch or loop, or not at '
                'all: '
                'make the file with torch.jit.trace, or of the part up to this layer'
            )
        cuts.append((cut, module))
        for part in cut.path:
            module = module.getattr(part)
        method, rest = cut.method, rest[len(cut.path) :]
    inner = module._get_method(method)

    def run(images: torch.Tensor) -> Any:
        values: tuple[Any, ...] = (images,)
        for cut, owner in cuts:
            result = cut.program(owner, *values)
            values = result if cut.arguments > 1 else (result,)
        return inner(*values)

    return run


class _Cut(NamedTuple):
    """A module's program, cut off before it calls another module."""

    program: Callable[..., Any]  # returns the arguments of that call, a tuple if several
    arguments: int  # their number
    path: list[str]  # of the called module
    method: str  # forward; further calls in a traced file: forward1 and so on


def _before_call(graph: Any, path: list[str]) -> _Cut | None:
    """Cut a program off before its last call of the first module on a path; None without one."""
    nodes = list(graph.nodes())
    for i in reversed(range(len(nodes))):
        if nodes[i].kind() != 'prim::CallMethod':
            continue
        method = nodes[i].s('name')
        callee, *arguments = nodes[i].inputs()
        names = _names_of(callee)
        if not re.fullmatch(r'forward\d*', method):
            continue
        if not names or path[: len(names)] != names:
            continue
        for _ in list(graph.outputs()):
            graph.eraseOutput(0)
        for value in arguments:
            graph.registerOutput(value)
        for node in reversed(nodes[i:]):
            node.destroy()
        if len(arguments) > 1:
            graph.makeMultiOutputIntoTuple()
        program = torch._C._create_function_from_graph('cut', graph)
        return _Cut(program, len(arguments), names, method)
    return None


def _names_of(value: Any) -> list[str]:
    """Return the attributes that lead from the module itself to one inside it."""
    names: list[str] = []
    while value.node().kind() == 'prim::GetAttr':
        names.insert(0, value.node().s('name'))
        value = next(value.node().inputs())
    return names
