"""What a node's recorded answers to one drive are worth: the matches against the truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stavpr_ros.evaluation.metrics import FrameAnswers, Score, WindowAnswer, frame_answers, score_at

IN_WINDOW = ('WARMING_UP', 'NO_MATCH', 'MATCH')  # statuses of images that the window holds


@dataclass(frozen=True)
class DriveResult:
    """
    The answers to N images.

    :param answers: place and distance of each image, windows assigned to their midpoints.
    :param accepted: distance below the threshold, shape (N,), bool.
    :param truth: true place of each image, -1 = not in the map, shape (N,); None = unknown.
    :param score: counts at the threshold; None without truth.
    :param seconds: between one answer and the next, shape (N - 1,): the round trip of an image.
    """

    answers: FrameAnswers
    accepted: np.ndarray
    truth: np.ndarray | None
    tolerance: int
    score: Score | None
    seconds: np.ndarray

    @property
    def matched(self) -> np.ndarray:
        """Accepted place of each image, -1 = none, shape (N,)."""
        return np.where(self.accepted, self.answers.places, -1)

    @property
    def correct(self) -> np.ndarray | None:
        """Accepted and within the tolerance of the truth, shape (N,), bool."""
        return None if self.truth is None else self.accepted & self.answers.within(self.truth, self.tolerance)

    @property
    def headline(self) -> str:
        """The result in a line."""
        line = f'{np.count_nonzero(self.accepted)} of {len(self.accepted)} images matched'
        if self.score is not None:
            s = self.score
            line += f', precision {s.precision:.2f}, recall {s.recall:.2f}, F1 {s.f1:.2f}'
        return f'{line}; {1 / self.seconds.mean():.0f} images per second' if len(self.seconds) else line

    def summary(self) -> str:
        """Return the result in words, a line each."""
        lines = [f'{np.count_nonzero(self.accepted)} of {len(self.accepted)} images matched']
        if self.truth is not None and self.score is not None:
            s, unseen = self.score, self.truth < 0
            lines.append(f'precision {s.precision:.3f}   recall {s.recall:.3f}   F1 {s.f1:.3f}')
            lines.append(f'(right means within {self.tolerance} places of the truth)')
            if unseen.any():
                wrong = np.count_nonzero(self.accepted & unseen)
                lines.append(
                    f'{wrong} of {np.count_nonzero(unseen)} images of unseen places matched all the same'
                )
        if not len(self.seconds):
            return '\n'.join(lines)
        median, slow = np.percentile(self.seconds, [50, 99]) * 1e3
        lines.append(
            f'{1 / self.seconds.mean():.1f} images per second, one after the other; from image to answer '
            f'{median:.1f} ms (median), {slow:.1f} ms (99 %), replay and transport included'
        )
        return '\n'.join(lines)


def window_answer(record: dict[str, Any]) -> WindowAnswer | None:
    """Read a window's answer from a record of the command ``record``; None if it has none."""
    if record['sequence_middle'] < 0:
        return None
    return WindowAnswer(record['sequence_middle'], record['distance'], np.array(record['path'], np.int32))


def _answers(records: list[dict[str, Any]], length: int) -> FrameAnswers:
    """Assign windows to images; an image that was in no window (invalid, dropped) has no answer."""
    taken = np.array([record['status'] in IN_WINDOW for record in records], bool)
    windows = [window_answer(record) for record in records if record['status'] in IN_WINDOW]
    among_taken = frame_answers(windows, length)
    places, distances = np.full(len(records), -1, np.int64), np.full(len(records), np.inf)
    places[taken], distances[taken] = among_taken.places, among_taken.distances
    return FrameAnswers(places, distances)


def judge(
    records: list[dict[str, Any]], length: int, threshold: float, truth: np.ndarray | None, tolerance: int
) -> DriveResult:
    """
    Compare recorded answers with the truth.

    :param records: one an image, in order.
    :param length: images in a window, l.
    :param truth: true place of each image, -1 = not in the map; None = unknown.
    :param tolerance: places.
    """
    answers = _answers(records, length)
    score = None
    if truth is not None:
        score = score_at(threshold, answers.distances, answers.within(truth, tolerance), truth >= 0)
    received = np.array([record['received'] for record in records], float) / 1e9
    return DriveResult(answers, answers.distances < threshold, truth, tolerance, score, np.diff(received))
