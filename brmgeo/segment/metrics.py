"""How good masks are: counts that add up over frames, and the scores and the calibration that follow from them.

Besides pixels and outlines, what masks are for is scored: the ratio features f_k of the building ratio map paper (share of
building in n discs about the picture's middle, eq. 1 and 2), whose errors a matcher has to live with.

Labels are uint8: 0 other, 255 building, 127 unknown; unknown pixels count nowhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
RELIABILITY_BINS = 10


@dataclass(frozen=True, slots=True)
class MaskScores:
    """Counts of one or more frames; ``a + b`` is the counts of both.

    Attributes:
        hit, false, missed, rest: pixels that are building in both, in the estimate only, in the label only, in neither.
        edge_estimate, edge_estimate_hit: pixels on outlines of the estimate, and those within the tolerance of a true one.
        edge_label, edge_label_hit: pixels on true outlines, and those within the tolerance of an estimated one.
        features, feature_error: number of features f_k, and the sum of their absolute errors.
        frames: number of frames.
    """

    hit: int = 0
    false: int = 0
    missed: int = 0
    rest: int = 0
    edge_estimate: int = 0
    edge_estimate_hit: int = 0
    edge_label: int = 0
    edge_label_hit: int = 0
    features: int = 0
    feature_error: float = 0.0
    frames: int = 0

    def __add__(self, other: MaskScores) -> MaskScores:
        return MaskScores(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    @property
    def accuracy(self) -> float:
        """Share of known pixels that are right."""
        return _share(self.hit + self.rest, self.hit + self.false + self.missed + self.rest)

    @property
    def iou(self) -> float:
        """Intersection over union of building; 1 where neither has any."""
        return _share(self.hit, self.hit + self.false + self.missed)

    @property
    def precision(self) -> float:
        """Share of the estimate that is building."""
        return _share(self.hit, self.hit + self.false)

    @property
    def recall(self) -> float:
        """Share of building that is in the estimate."""
        return _share(self.hit, self.hit + self.missed)

    @property
    def boundary_f1(self) -> float:
        """Harmonic mean of the shares of both outlines that lie within the tolerance of the other."""
        p, r = (
            _share(self.edge_estimate_hit, self.edge_estimate),
            _share(self.edge_label_hit, self.edge_label),
        )
        return 2 * p * r / (p + r) if p + r > 0 else 0.0

    @property
    def feature_mae(self) -> float:
        """Mean absolute error of the features f_k; NaN without any."""
        return self.feature_error / self.features if self.features else math.nan

    def summary(self) -> dict[str, float]:
        """The scores by name, rounded to four places."""
        names = ("accuracy", "iou", "precision", "recall", "boundary_f1", "feature_mae")
        return {name: round(float(getattr(self, name)), 4) for name in names} | {"frames": self.frames}


def _share(part: float, whole: float) -> float:
    return part / whole if whole else 1.0


def segmentation_scores(
    probability: F32, label: U8, threshold: float, gsd_m: float, *, n: int = 3, tolerance_m: float = 1.0
) -> MaskScores:
    """The counts of one frame.

    Args:
        probability: (h, w) float32; building above ``threshold``. NaN counts as not building.
        label: (h, w) uint8: 0, 255, or 127 for unknown.
        threshold: as the model card has it.
        gsd_m: metres per pixel, for the tolerance.
        n: number of discs of the features f_k.
        tolerance_m: outlines that are this near to each other are the same.

    Raises ValueError for arrays of different shapes.
    """
    if probability.shape != label.shape:
        raise ValueError(
            f"a probability of {probability.shape} and a label of {label.shape} are not of one frame"
        )
    known = label != UNKNOWN
    truth = label == BUILDING
    estimate = (probability > threshold) & known
    hit = int(np.count_nonzero(estimate & truth))
    false, missed = int(np.count_nonzero(estimate & ~truth)), int(np.count_nonzero(truth & ~estimate))
    reach = tolerance_m / gsd_m
    edges = _outline(estimate, known), _outline(truth, known)
    near = [_near(e, reach) for e in edges]
    f_estimate, f_truth = ring_features(estimate, known, n), ring_features(truth, known, n)
    measured = np.isfinite(f_truth)
    return MaskScores(
        hit=hit,
        false=false,
        missed=missed,
        rest=int(np.count_nonzero(known)) - hit - false - missed,
        edge_estimate=int(np.count_nonzero(edges[0])),
        edge_estimate_hit=int(np.count_nonzero(edges[0] & near[1])),
        edge_label=int(np.count_nonzero(edges[1])),
        edge_label_hit=int(np.count_nonzero(edges[1] & near[0])),
        features=int(np.count_nonzero(measured)),
        feature_error=float(np.abs(f_estimate - f_truth)[measured].sum()),
        frames=1,
    )


def _outline(mask: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of the mask that have a known neighbour (of four) outside of it; the picture's edge is no outline."""
    outside = np.pad(known & ~mask, 1)
    touches = outside[:-2, 1:-1] | outside[2:, 1:-1] | outside[1:-1, :-2] | outside[1:-1, 2:]
    return mask & touches


def _near(edge: NDArray[np.bool_], reach_px: float) -> NDArray[np.bool_]:
    if not edge.any():
        return np.zeros_like(edge)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= reach_px + 1e-4)


def ring_features(mask: NDArray[np.bool_], known: NDArray[np.bool_], n: int = 3) -> NDArray[np.float64]:
    """(n,) float64: f_k, share of building in discs about the picture's middle, largest first (eq. 1, 2).

    The largest disc touches the sides of the largest centred square; the k-th has (n + 1 - k) / n of its radius. A pixel
    belongs to a disc when its centre does; shares are of known pixels, NaN where a disc has none.
    """
    h, w = mask.shape
    y, x = np.arange(h)[:, None] + 0.5 - h / 2, np.arange(w)[None, :] + 0.5 - w / 2
    d2 = y * y + x * x
    out = np.full(n, np.nan)
    for k in range(1, n + 1):
        disc = known & (d2 <= (min(h, w) / 2 * (n + 1 - k) / n) ** 2)
        count = np.count_nonzero(disc)
        if count:
            out[k - 1] = np.count_nonzero(mask & disc) / count
    return out


@dataclass(slots=True)
class LogitHistogram:
    """How often each logit was given to buildings and to other ground; all that calibration and threshold need.

    ``add`` frames of validation, then ``calibration`` and ``reliability``, and ``best_threshold`` of several. Logits
    beyond +-``LIMIT`` count as that; bins are 0.05 wide, so what follows is exact to 0.6 % of probability.
    """

    LIMIT = 16.0
    BINS = 640
    building: NDArray[np.int64] = field(default_factory=lambda: np.zeros(640, np.int64))
    other: NDArray[np.int64] = field(default_factory=lambda: np.zeros(640, np.int64))

    def add(self, logits: F32, label: U8) -> None:
        """Counts the known pixels of (h, w) float32 logits and their uint8 label; NaN logits are left out."""
        usable = np.isfinite(logits) & (label != UNKNOWN)
        shown = np.clip(logits[usable].astype(np.float64), -self.LIMIT, self.LIMIT)
        index = np.minimum(np.floor((shown + self.LIMIT) / 0.05).astype(int), self.BINS - 1)
        truth = label[usable] == BUILDING
        self.building += np.bincount(index[truth], minlength=self.BINS)
        self.other += np.bincount(index[~truth], minlength=self.BINS)

    @property
    def logits(self) -> NDArray[np.float64]:
        """(BINS,) float64, the middle of each bin."""
        return np.asarray((np.arange(self.BINS) + 0.5) * 0.05 - self.LIMIT, np.float64)

    def entropy(self, temperature: float, shift: float) -> float:
        """Mean cross-entropy, nats a pixel, of sigmoid((logit + shift) / temperature)."""
        x = (self.logits + shift) / temperature
        cost = self.building * np.logaddexp(0, -x) + self.other * np.logaddexp(0, x)
        return float(cost.sum() / max(int((self.building + self.other).sum()), 1))

    def calibration(self) -> tuple[float, float]:
        """(temperature, shift) whose sigmoid((logit + shift) / temperature) has the lowest cross-entropy (Platt 1999).

        A temperature alone (Guo et al. 2017) leaves 0.5 where it is, and a loss that favours the rare class, such as soft
        Dice, moves just that. The temperature is between 0.2 and 5, the shift between -5 and 5; (1, 0) without both classes.
        """
        if not self.building.any() or not self.other.any():
            return 1.0, 0.0

        def cost(v: NDArray[np.float64]) -> float:
            return self.entropy(math.exp(v[0]), float(v[1]))

        limits = [(math.log(0.2), math.log(5.0)), (-5.0, 5.0)]
        found = minimize(cost, np.zeros(2), method="L-BFGS-B", bounds=limits)
        return float(math.exp(found.x[0])), float(found.x[1])

    def ious(self) -> NDArray[np.float64]:
        """(BINS,) float64: the IoU of building where the bins after each one are called that."""
        hit = self.building[::-1].cumsum()[::-1]
        false = self.other[::-1].cumsum()[::-1]
        union = self.building.sum() + np.append(false[1:], 0)
        return np.asarray(np.append(hit[1:], 0) / np.maximum(union, 1), np.float64)

    def reliability(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """(mean probability, share of building, pixels) of RELIABILITY_BINS equal bins of probability; NaN in empty ones."""
        p = 1 / (1 + np.exp(-self.logits))
        both = self.building + self.other
        index = np.minimum((p * RELIABILITY_BINS).astype(int), RELIABILITY_BINS - 1)
        count = np.bincount(index, both, RELIABILITY_BINS)
        with np.errstate(invalid="ignore"):
            said = np.bincount(index, both * p, RELIABILITY_BINS) / count
            was = np.bincount(index, self.building, RELIABILITY_BINS) / count
        return said, was, count.astype(np.int64)

    def calibration_error(self) -> float:
        """Expected calibration error: mean over pixels of ``|share of building - probability|`` of their bin."""
        said, was, count = self.reliability()
        filled = count > 0
        return float((np.abs(said - was)[filled] * count[filled]).sum() / max(int(count.sum()), 1))


def best_threshold(grounds: Sequence[LogitHistogram]) -> tuple[float, float]:
    """The probability above which building has the highest mean of the grounds' IoUs, and that mean.

    A mean of IoUs, not the IoU of all pixels: else the ground with the most building would choose alone. Grounds without
    both classes have no say; (0.5, 0.0) where none has.
    """
    told = [g for g in grounds if g.building.any() and g.other.any()]
    if not told:
        return 0.5, 0.0
    mean = np.mean([g.ious() for g in told], axis=0)
    edge = told[0].logits[int(np.argmax(mean))] + 0.025
    return float(np.clip(1 / (1 + np.exp(-edge)), 0.01, 0.99)), float(mean.max())
