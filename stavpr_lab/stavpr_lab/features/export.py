# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Any network to one ONNX file with the outputs ``global`` (n, D) and ``map`` (n, C, H, W).

A network in Python is a program of somebody else. It runs here, once, to be recorded; nodes and
maps only read the ONNX file, which is data. Requires the extra ``onnx``.
"""

from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
import io
from pathlib import Path
import tempfile
from typing import Any
import warnings

import numpy as np
from stavpr_lab.features.weights import last_line
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.onnx import as_maps, BATCH, import_onnx, ON_CPU, TOLERANCE
import torch
from torch import nn

GLOBAL, MAP = 'global', 'map'
MAX_BYTES = 2**31  # bytes of an ONNX file: limit of its format
OPSET = 17
CHECKED = 3  # random images that the file is verified on


@dataclass(frozen=True)
class Exported:
    """
    An ONNX file that was verified against the original.

    :param content: the file.
    :param shapes: shape of each output for one image.
    :param difference: largest one from the original, over the largest value.
    :param batch: whether several images may be computed at once.
    """

    content: bytes
    shapes: dict[str, tuple[int, ...]]
    difference: float
    batch: bool


def load_hub(repository: str, commit: str, entry: str, arguments: Mapping[str, Any]) -> nn.Module:
    """
    Run an entry of a repository's ``hubconf.py``, which may do anything this user may.

    :param repository: ``OWNER/NAME`` on GitHub, or a folder.
    :param commit: 40 hexadecimal digits; '' for a folder.
    :raises UnavailableError: it cannot be had, or fails.
    """
    local = Path(repository).is_dir()
    if not local and (len(commit) != 40 or set(commit) - set('0123456789abcdef')):
        raise SettingsError(
            f'commit {commit!r} of {repository}: expected 40 digits 0-9 a-f; a branch or a tag '
            'would be another program tomorrow'
        )
    try:
        network = torch.hub.load(
            repository if local else f'{repository}:{commit}',
            entry,
            source='local' if local else 'github',
            trust_repo=True,
            **({} if local else {'skip_validation': True}),
            **arguments,
        )
    except Exception as error:  # any program may raise any error
        raise UnavailableError(
            f'entry {entry} of {repository} {commit} fails: {type(error).__name__}: '
            f'{last_line(error)}'
        ) from error
    if not isinstance(network, nn.Module):
        raise UnavailableError(
            f'entry {entry} of {repository} returns a {type(network).__name__}: expected a '
            'torch.nn.Module'
        )
    return network.module if isinstance(network, nn.DataParallel) else network


class Chosen(nn.Module):
    """
    The chosen outputs of a network, which become the outputs of the file.

    :param vector: number or key of the network's output (n, D); '' = no output ``global``.
    :param module: path of the module whose output is the map; '' = the network's own output.
    :param map: number or key of the output that is the map, or tokens; '' = no output ``map``.
    :param prefix_tokens: leading tokens that are no patches.
    :raises SettingsError: neither is chosen, or there is no such module.
    """

    def __init__(
        self,
        network: nn.Module,
        vector: str = '0',
        module: str = '',
        map: str = '',  # noqa: A002
        prefix_tokens: int = 1,
    ) -> None:
        super().__init__()
        if not vector and not map:
            raise SettingsError('neither a vector nor a map is chosen: name one of the outputs')
        self.names = [name for name, output in ((GLOBAL, vector), (MAP, map)) if output]
        self.network = network.eval().float()
        self._vector, self._module, self._map, self._prefix = vector, module, map, prefix_tokens
        self._module_outputs: list[Any] = []
        if map and module:
            try:
                inner = network.get_submodule(module)
            except AttributeError as error:
                names = [name for name, _ in network.named_modules() if name]
                raise SettingsError(
                    f'the network has no module {module!r}: its modules are '
                    f'{", ".join(names[:60])}'
                ) from error
            inner.register_forward_hook(lambda *call: self._module_outputs.append(call[-1]))

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """
        Return the vectors (n, D) and the maps (n, C, H, W) of images (n, 3, size, size).

        :raises SettingsError: the network has no such outputs, or of another shape.
        """
        outputs = []
        self._module_outputs.clear()
        results = self.network(images)
        if self._vector:
            vector = one_of(results, self._vector, 'the network')
            if not isinstance(vector, torch.Tensor) or vector.ndim != 2:
                shape = getattr(vector, 'shape', type(vector).__name__)
                raise SettingsError(
                    f'output {self._vector!r} of the network is {shape}: expected a vector (n, D)'
                )
            outputs.append(vector)
        if self._map:
            if self._module and not self._module_outputs:
                raise SettingsError(f'module {self._module!r} is not called by the network')
            owner = self._module_outputs[-1] if self._module else results
            output = one_of(owner, self._map, self._module or 'the network')
            name = f'module {self._module!r}' if self._module else f'output {self._map!r}'
            maps = as_maps(output, len(images), self._prefix, name)
            if maps.ndim != 4:
                raise SettingsError(f'{name} returns vectors {tuple(maps.shape)}: expected a map')
            outputs.append(maps)
        return tuple(outputs)


def one_of(output: Any, which: str, name: str) -> Any:
    """
    Return one output of a network that returns a tuple, a list or a dictionary.

    :param which: its number from 0, or its key; a single output has the number 0.
    :param name: name of the network.
    :raises SettingsError: there is none of this number or key.
    """
    outputs: dict[str, Any] = {'0': output}
    if isinstance(output, Mapping):
        outputs = {str(key): value for key, value in output.items()}
    elif isinstance(output, Sequence):
        outputs = {str(i): value for i, value in enumerate(output)}
    if which not in outputs:
        raise SettingsError(
            f'{name} has no output {which!r}: its outputs are {", ".join(outputs)}'
        )
    return outputs[which]


def export_network(outputs: Chosen, size: int) -> Exported:
    """
    Record a network as an ONNX file, and verify it on random images.

    The reference are the original's outputs for single images. If the file equals them for a batch
    as well, batches are permitted; else the file states that it takes one image at a time.

    :param size: side of the images, pixels.
    :raises SettingsError: the network has no such outputs.
    :raises UnavailableError: it cannot be recorded, or the file computes something else.
    """
    weights = sum(value.nbytes for value in outputs.state_dict().values())
    if weights >= MAX_BYTES:
        raise UnavailableError(
            f'the network has {weights / 1e9:.1f} GB of weights, the limit of an ONNX file '
            '(2 GiB): compute its descriptors with its own program, and give those'
        )
    images = torch.randn(CHECKED, 3, size, size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        singles = [outputs(image[None]) for image in images]
    references = [torch.cat(parts).numpy() for parts in zip(*singles, strict=True)]
    if not all(np.isfinite(reference).all() for reference in references):
        raise UnavailableError('the network returns NaN or infinite numbers for random images')
    reasons = []
    for batch, step in ((2, CHECKED), (1, 1)):  # recorded with two images; else with one
        try:
            content = _record(outputs, images[:batch], alone=step == 1)
            difference = _difference(content, images.numpy(), references, step)
        except Exception as error:  # of the network, the recorder and the runtime
            reasons.append(last_line(error))
            continue
        if difference <= TOLERANCE:
            shapes = {n: (1, *r.shape[1:]) for n, r in zip(outputs.names, references, strict=True)}
            return Exported(content, shapes, difference, step > 1)
        reasons.append(f'its outputs differ by {difference:.2g}')
    raise UnavailableError(
        f'the network cannot be exported. Recorded with two images: {reasons[0]}. With one: '
        f'{reasons[1]}'
    )


def _record(outputs: Chosen, images: torch.Tensor, alone: bool) -> bytes:
    onnx, _ = import_onnx()
    axes = {name: {0: 'batch'} for name in ('image', *outputs.names)}
    with (
        tempfile.TemporaryDirectory() as folder,
        warnings.catch_warnings(),
        redirect_stdout(io.StringIO()),  # the whole graph, in case of an error
        torch.no_grad(),
    ):
        path = Path(folder) / 'recorded.onnx'
        warnings.simplefilter('ignore')  # of recording sizes as constants: the result is verified
        torch.onnx.export(
            outputs,
            (images,),
            path,
            input_names=['image'],
            output_names=outputs.names,
            dynamic_axes=None if alone else axes,
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load_model_from_string(path.read_bytes())
    if alone:
        onnx.helper.set_model_props(model, {BATCH: '1'})
    return model.SerializeToString()


def _difference(
    content: bytes, images: np.ndarray, references: list[np.ndarray], step: int
) -> float:
    """Return the largest difference of a file's outputs, ``step`` images at a time."""
    _, onnxruntime = import_onnx()
    session = onnxruntime.InferenceSession(content, providers=[ON_CPU])
    largest = 0.0
    for first in range(0, len(images), step):
        results = session.run(None, {'image': images[first : first + step]})
        for output, reference in zip(results, references, strict=True):
            expected = reference[first : first + step]
            if output.shape != expected.shape:
                raise UnavailableError(f'shape {output.shape}, expected {expected.shape}')
            scale = max(float(abs(expected).max()), 1e-12)
            largest = max(largest, float(abs(output - expected).max()) / scale)
    return largest
