"""The picture of all distances with the true and the answered places, for drives of any length."""

from pathlib import Path
from typing import Any

import numpy as np

from stavpr_ros.evaluation import plots
from stavpr_ros.evaluation.evaluate import ReducedDistances, Evaluation
from stavpr_ros.evaluation.ground_truth import GroundTruth


def accepted_answers(evaluation: Evaluation, truth: GroundTruth) -> dict[str, np.ndarray]:
    """
    Return the window answers that are accepted at the threshold of the best F1.

    :returns: image and place, shape (count, 2), of the right and of the wrong ones.
    """
    answers = evaluation.results.sequence
    accepted = answers.scores < evaluation.sequence.best.threshold
    right = truth.accepts(answers.best)
    pairs = np.stack([np.arange(len(answers)), answers.best], axis=1)
    return {'right': pairs[accepted & right], 'wrong': pairs[accepted & ~right]}


def _true_cells(picture: ReducedDistances, truth: GroundTruth) -> np.ndarray:
    """Color the cells with a true place, the others clear: RGBA, shape (rows, columns, 4), uint8."""
    cells = np.zeros((*picture.values.shape, 4), np.uint8)
    rows, columns = (truth.pairs // picture.block).T
    cells[rows, columns] = [int(plots.TRUTH[i : i + 2], 16) for i in (1, 3, 5)] + [110]
    return cells


def draw_matrix(path: Path, evaluation: Evaluation, truth: GroundTruth) -> Path:
    """
    Draw the distance of every image to every place, the true places and the accepted answers.

    :returns: the path.
    """
    picture = evaluation.results.distances
    side = 7.5
    with plots.page(path, side, float(np.clip(side * truth.N / truth.n, 4, 9))) as figure:
        axes = figure.add_subplot()
        extent = (-0.5, truth.n - 0.5, truth.N - 0.5, -0.5)
        finite = picture.values[np.isfinite(picture.values)]
        low, high = np.quantile(finite, [0.002, 0.995]) if finite.size else (0.0, 1.0)
        scale: dict[str, Any] = {'cmap': plots.SCALE, 'vmin': low, 'vmax': max(high, low + 1e-6)}
        image = axes.imshow(picture.values, aspect='auto', extent=extent, **scale)
        axes.imshow(_true_cells(picture, truth), aspect='auto', extent=extent, interpolation='nearest')
        axes.plot([], [], 's', color=plots.TRUTH, ms=4, label='true place')
        for outcome, pairs in accepted_answers(evaluation, truth).items():
            if len(pairs):
                style: dict[str, Any] = {
                    'color': plots.BRIGHT[outcome],
                    'label': plots.MEANING[outcome],
                }
                axes.plot(pairs[:, 1], pairs[:, 0], '.', ms=4, mew=0, **style)
        axes.set(xlabel='place in the map', ylabel='query image')
        axes.set(xlim=extent[:2], ylim=extent[2:])
        plots.color_bar(figure, image, axes)
        for handle in plots.legend_above(axes, 3).get_lines():
            handle.set_markersize(9)
    return path
