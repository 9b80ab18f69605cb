"""Floors: the time below which a stage cannot be done, from its bytes and operations and the ceilings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

ITEM_BYTES = {'float32': 4, 'bfloat16': 2, 'float16': 2}

# Operations of one inner cell. Of LM-DTW: three sums x + S, two minima of them, the cost of the chosen
# predecessor (two selections), its increment. The image distance's diagonal costs a * x besides. What
# compares and selects together counts once: fewer operations are a lower, stricter floor.
SEQUENCE_CELL = 8
SPATIAL_CELL = 9
BEYOND_CACHES = 2**28  # bytes
BORDER_CELL = 2  # one predecessor: S + x, C + 1


@dataclass(frozen=True)
class Sizes:
    """
    The sizes of one problem, in the paper's symbols.

    :param n: places.
    :param d: dimensions of a local feature.
    :param W: strips of an image.
    :param l: images of the window.
    :param k: map images that a start sees.
    :param xi: half width of the band of the spatial alignment, W for none.
    """

    n: int
    d: int = 512
    W: int = 7
    l: int = 20
    k: int = 40
    xi: int = 7

    @property
    def cells(self) -> int:
        """Cells that LM-DTW updates: l k for each of n starts."""
        return self.n * self.l * self.k

    @property
    def pairs(self) -> int:
        """Pairs of strips that the band allows, of W x W."""
        return sum(abs(i - j) < self.xi for i in range(self.W) for j in range(self.W))


@dataclass(frozen=True)
class Part:
    """
    One stage of a figure.

    :param bytes: that must be read at least once.
    :param operations: that must be done, an addition and a multiplication counted as two.
    :param dtype: the precision whose peak counts.
    """

    bytes: float
    operations: float
    dtype: str = 'float32'


@dataclass(frozen=True)
class Ceilings:
    """
    What the machine can do, measured in the same run.

    :param read_bytes_per_s: read bandwidth with all cores, or of the device.
    :param operations_per_s: peak of the large matrix product, by precision.
    :param read_one_core_bytes_per_s: read bandwidth with one core; None on a GPU.
    :param sources: of ``read`` or a precision, where it was not its own measurement that showed most.
    """

    read_bytes_per_s: float
    operations_per_s: dict[str, float]
    read_one_core_bytes_per_s: float | None = None
    sources: dict[str, str] = field(default_factory=dict)

    def best(self, other: 'Ceilings') -> 'Ceilings':
        """Return the higher of two measurements of each ceiling."""
        one, two = self.read_one_core_bytes_per_s, other.read_one_core_bytes_per_s
        return Ceilings(
            max(self.read_bytes_per_s, other.read_bytes_per_s),
            {k: max(v, other.operations_per_s[k]) for k, v in self.operations_per_s.items()},
            max(one, two) if one and two else None,
            other.sources | self.sources,
        )

    def raised(self, part: Part, seconds: float, source: str) -> 'Ceilings':
        """
        Return the ceilings, raised to what a stage has shown, so that no floor lies above a figure.

        A machine that others use may be busier while a ceiling is measured than later. Bytes count only
        where they are too many for any cache.

        :param part: what was done at least.
        :param seconds: how long it took.
        :param source: the stage, in words.
        """
        raised = self
        operations, read = part.operations / seconds, part.bytes / seconds
        if operations > self.operations_per_s[part.dtype]:
            peaks = self.operations_per_s | {part.dtype: operations}
            raised = replace(raised, operations_per_s=peaks, sources=raised.sources | {part.dtype: source})
        if part.bytes >= BEYOND_CACHES and read > self.read_bytes_per_s:
            raised = replace(raised, read_bytes_per_s=read, sources=raised.sources | {'read': source})
        return raised.widened()

    def widened(self) -> 'Ceilings':
        """Let no half-width precision be slower than float32, to which it can be widened."""
        least = self.operations_per_s['float32']
        slower = {dtype: least for dtype, peak in self.operations_per_s.items() if peak < least}
        sources = self.sources | dict.fromkeys(slower, 'float32')
        return replace(self, operations_per_s=self.operations_per_s | slower, sources=sources)


def floor_seconds(parts: Sequence[Part], ceilings: Ceilings) -> float:
    """Return the sum over the parts of the larger of reading their bytes and doing their operations."""
    return sum(
        max(
            part.bytes / ceilings.read_bytes_per_s,
            part.operations / ceilings.operations_per_s[part.dtype],
        )
        for part in parts
    )


def product(sizes: Sizes, dtype: str, frames: int = 1, whole: bool = False) -> Part:
    """
    The product of the strips of so many frames with the map.

    :param whole: all W x W pairs, as the bare product has them, instead of those in the band.
    """
    pairs = sizes.W**2 if whole else sizes.pairs
    map_bytes = sizes.W * sizes.n * sizes.d * ITEM_BYTES[dtype]
    return Part(map_bytes, 2 * frames * pairs * sizes.n * sizes.d, dtype)


def alignment(sizes: Sizes, frames: int = 1) -> Part:
    """Spatial alignment; it may read the strip distances from where the product left them: no bytes."""
    border = 2 * (min(sizes.W, sizes.xi) - 1)
    inner = sizes.pairs - 1 - border
    return Part(0, frames * sizes.n * (inner * SPATIAL_CELL + border * BORDER_CELL + 1))


def sequence(sizes: Sizes) -> Part:
    """LM-DTW: the window is read once; a division and a minimum for each end."""
    l, k = sizes.l, sizes.k
    each = (l - 1) * (k - 1) * SEQUENCE_CELL + (l + k - 2) * BORDER_CELL + 2 * k
    return Part(4 * l * sizes.n, sizes.n * each)


def selection(sizes: Sizes) -> Part:
    """Nearest and second best: the distance and the length of each start are read once."""
    return Part(8 * sizes.n, 6 * sizes.n)  # two minima; the midpoint, its difference, the comparison


FRAMES = 20  # of the distance matrix
STAGES: dict[str, Callable[[Sizes, str], list[Part]]] = {
    'product': lambda sizes, dtype: [product(sizes, dtype, whole=True)],
    'image_distances': lambda sizes, dtype: [product(sizes, dtype), alignment(sizes)],
    'distance_matrix': lambda sizes, dtype: [product(sizes, dtype, FRAMES), alignment(sizes, FRAMES)],
    'lm_dtw': lambda sizes, dtype: [sequence(sizes)],
    'select': lambda sizes, dtype: [selection(sizes)],
    'retrieval': lambda sizes, dtype: [sequence(sizes), selection(sizes)],
    'online_frame': lambda sizes, dtype: [
        product(sizes, dtype),
        alignment(sizes),
        sequence(sizes),
        selection(sizes),
    ],
}
