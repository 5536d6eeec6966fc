"""Likeness of real touch images: the learned log-odds of one object against two, beside nearest neighbour.

Eight actuated whiskers that felt ten objects (six runs of 30 touches each, one run left out in turn), and
three fingertips of 22 taxels that touched six objects (one contact left out in turn). Each held-out image is
compared with all images that were learned from. The model is that of recall
(`ratslam.recall.signed_likelihood`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import expit, logit

from evaluation.metrics.statistics import auc, expected_calibration_error
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import table_lines
from evaluation.papers.tables.recordings import require_recordings
from ratslam.recall.signed_likelihood import learn, log_odds, project, stored_image
from robot.recordings.real_whiskers import read_contacts, read_object
from tactile.base.random_streams import stream

OBJECTS = "real_touch/actuated_whisker_purdue/data/objCls"
TAXELS = "real_touch/txzy_sheffield/TXZY_dataI.mat"
BLOCK = 30
"""Touches in a run of one object."""
DEVELOPED = (0, 1, 2)
"""Blocks on which the model was chosen; the others confirm it."""
PAIRS = 4000
"""Largest number of pairs of one object that are learned from."""
BINS = 10


class _HeldOut(NamedTuple):
    """Comparisons of H held-out images with M others.

    Attributes:
        odds: [H, M] log-odds of one object against two. same: [H, M] bool. recognised: share of the images
            whose most similar other is of the same object, by the log-odds and by the distances of
            `DISTANCES`. distance: [H, M] the first of these.
    """

    odds: np.ndarray
    same: np.ndarray
    recognised: dict[str, float]
    distance: np.ndarray


DISTANCES = {
    "nearest neighbour, absolute differences": (1, False),
    "nearest neighbour, Euclidean": (2, False),
    "nearest neighbour, absolute differences of roots": (1, True),
}
"""Order of the norm, and whether it is of the signed roots."""


_Likeness = tuple[list[_HeldOut], list[_HeldOut]]
"""Held-out comparisons: of each block of the whiskers, and of all contacts of the taxels."""


def _measure(folder: Path) -> _Likeness:
    """Compares all held-out images."""
    objects, taxels = require_recordings(folder, OBJECTS, TAXELS)
    # The touches of all objects, in runs of 30; and an image of each contact, its mean pressures.
    views = [read_object(path)[0].reshape(-1, 128) for path in sorted(objects.glob("*.csv"))]
    count = [len(rows) for rows in views]
    run = np.concatenate([np.arange(rows) // BLOCK for rows in count])
    whiskers = np.concatenate(views), np.repeat(np.arange(len(views)), count), run
    felt = read_contacts(taxels)
    pressures = np.stack([contact.pressure.mean(axis=0).reshape(-1) for contact in felt])
    contact = np.arange(len(felt))
    contacts = pressures, np.array([contact.object for contact in felt]), contact
    return (
        [_hold_out(*whiskers, run == block) for block in np.unique(run)],
        [_hold_out(*contacts, contact == k) for k in contact],
    )


def _hold_out(views: np.ndarray, thing: np.ndarray, run: np.ndarray, held: np.ndarray) -> _HeldOut:
    """Learns from the images that are not held out and compares the others with them.

    Args:
        views: [N, D] images as recorded. thing: [N] number of the object of each. run: [N] number of the run
            or contact: pairs to learn from are of different ones. held: [N] bool.
    """
    old, others, run = views[~held], thing[~held], run[~held]
    seen, felt, alive = views[held], thing[held], np.ones(views.shape[1], bool)
    stored = stored_image(old, alive)
    # Numbers of images: pairs of one object in different runs, [P] and [P], and pairs of two, [Q, 2].
    a, b = stream(0, "training pairs").integers(len(run), size=(2, 50 * PAIRS))
    alike = others[a] == others[b]
    one = np.flatnonzero(alike & (run[a] != run[b]))[:PAIRS]
    two = np.flatnonzero(~alike)[: 5 * PAIRS]
    pairs, apart = np.stack([stored[a[one]], stored[b[one]]]), np.column_stack([a[two], b[two]])
    model = learn(stored, pairs, apart)
    known = project(model, stored.T)
    found = project(model, stored_image(seen, alive).T)
    odds = np.stack([log_odds(model, image[:, None], known) for image in found.T])
    recognised = {"log-odds": float((others[odds.argmax(axis=1)] == felt).mean())}
    distances = []  # [H, M] sums of the absolute differences, to a power, of the images or of their roots
    for name, (order, roots) in DISTANCES.items():
        one, two = (np.sign(part) * np.sqrt(np.abs(part)) if roots else part for part in (seen, old))
        distances.append(np.stack([(np.abs(two - view) ** order).sum(axis=1) for view in one]))
        recognised[name] = float((others[distances[-1].argmin(axis=1)] == felt).mean())
    return _HeldOut(odds, felt[:, None] == others, recognised, distances[0])


def _probabilities(odds: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Probabilities [P] that pairs are of one object, from their log-odds and the share of such pairs."""
    return np.asarray(expit(odds + logit(same.mean())))


def _pooled(parts: list[_HeldOut]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log-odds, whether of one object, and distances, of all pairs of some comparisons."""
    odds = np.concatenate([part.odds.ravel() for part in parts])
    same = np.concatenate([part.same.ravel() for part in parts])
    return odds, same, np.concatenate([part.distance.ravel() for part in parts])


def _table(result: _Likeness) -> list[str]:
    """The lines of the table."""
    blocks, contacts = result
    chosen = [block for k, block in enumerate(blocks) if k in DEVELOPED]
    confirmed = [block for k, block in enumerate(blocks) if k not in DEVELOPED]
    names = ("log-odds", *DISTANCES)
    columns = (
        "images", "AUC (least of a block)", "AUC of absolute differences", "calibration error",
        f"recognised by {names[0]}", *DISTANCES, "chance",
    )  # fmt: skip
    lines = []
    rows: list[tuple[str, list[_HeldOut], bool]] = [
        ("8 whiskers, 10 objects, blocks 1-3 (model chosen on these)", chosen, True),
        ("the same, blocks 4-6 (confirming)", confirmed, True),
        ("the same, all six blocks", blocks, True),
        ("3 x 22 taxels, 6 objects, one contact left out (same model)", contacts, False),
    ]
    for label, parts, by_block in rows:
        odds, same, distance = _pooled(parts)
        areas = [auc(part.odds[~part.same], part.odds[part.same]) for part in parts]
        least = f" ({min(areas):.3f})" if by_block else ""
        cells = [label, f"{auc(odds[~same], odds[same]):.3f}{least}"]
        cells += [f"{auc(-distance[~same], -distance[same]):.3f}"]
        cells += [f"{expected_calibration_error(_probabilities(odds, same), same, BINS):.3f}"]
        cells += [f"{np.mean([part.recognised[name] for part in parts]):.3f}" for name in names]
        chance = np.mean([part.same.mean() for part in parts])  # share of pairs of one object
        lines.append([*cells, f"{chance:.2f}"])
    return table_lines([], columns, lines, NOTES)


NOTES = [
    "AUC: probability that two images of one object have larger log-odds than two of different objects; "
    "chance is 0.5. Pairs are of a held-out image and one that was learned from. Touches of a run follow "
    "each other, so that pairs within a run would be too easy. The first run differs most from the others. "
    "An image of the taxels is the mean of a contact. These contacts showed that many pairs of few images "
    "must not count as independent: the model holds for another sensor, but they are no longer unseen."
]


def _draw(result: _Likeness, png: Path) -> None:
    """Draws ROC, reliability and recognition."""
    blocks, contacts = result
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    kinds = {
        "whiskers, blocks 1-3": blocks[: len(DEVELOPED)],
        "whiskers, blocks 4-6": blocks[len(DEVELOPED) :],
        "taxels": contacts,
    }
    for color, (label, parts) in zip(("C0", "C1", "C2"), kinds.items(), strict=True):
        odds, same, distance = _pooled(parts)
        for score, style, of in ((odds, "-", "log-odds"), (-distance, ":", "absolute differences")):
            # Shares of the pairs of two objects and of one that are taken for one, as the limit falls.
            truth = same[np.argsort(-score, kind="stable")]
            shown = np.linspace(0, len(truth) - 1, min(len(truth), 2000)).astype(int)
            shares = [(np.cumsum(found) / found.sum())[shown] for found in (~truth, truth)]
            axes[0].plot(*shares, style, color=color, label=f"{label}: {of}")
        # Mean probability of one object against the share of such pairs, in bins of equally many pairs.
        chance = _probabilities(odds, same)
        bins = np.array_split(np.argsort(chance, kind="stable"), BINS)
        means = [[values[part].mean() for part in bins] for values in (chance, same)]
        axes[1].plot(*means, "o-", color=color, label=label)
    axes[0].plot([0, 1], [0, 1], color="0.7", lw=1, label="chance")
    axes[1].plot([0, 1], [0, 1], color="0.7", lw=1)
    axes[0].set(xlabel="different objects taken for one", ylabel="pairs of one object found", title="ROC")
    axes[1].set(xlabel="probability of one object", ylabel="share of one object", title="Reliability")
    axes[0].legend(fontsize=7, loc="lower right")
    axes[1].legend(fontsize=8, loc="upper left")
    _draw_recognition(axes[2], kinds)
    figure.savefig(png, dpi=150)
    plt.close(figure)


def _draw_recognition(axis: Any, kinds: dict[str, list[_HeldOut]]) -> None:
    """Bars of the shares of recognised objects."""
    names = ("log-odds", *DISTANCES)
    for k, name in enumerate(names):
        shares = [np.mean([part.recognised[name] for part in parts]) for parts in kinds.values()]
        place = np.arange(len(kinds)) + (k - 1.5) * 0.2
        bars = axis.bar(place, shares, 0.19, label=name, color=f"C{k}" if k else "k")
        axis.bar_label(bars, fmt="%.2f", fontsize=7)
    axis.set_xticks(range(len(kinds)), [label.replace(", ", ",\n") for label in kinds])
    axis.set(ylim=(0, 1.35), ylabel="objects recognised", title="Recognition")
    axis.legend(fontsize=7, loc="upper left")


FIGURE = Figure("Likeness of real touch images", _measure, _table, _draw)
