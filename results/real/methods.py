"""Methods beside the product, and how all of them are measured.

A method is given what was recorded, the presses to learn from and the presses to judge, as indices, and returns a
level for each of the latter. -1 is no verdict.
"""

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

SEED, DRAWS = 1, 2000
BINS = 8
# Counts from which changes are seen on a logarithmic scale.
SCALE = 16


def by_regression(inputs):
    def judge(recorded, learn, judged):
        seen = inputs(recorded)
        model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=5000))
        return model.fit(seen[learn], recorded.level[learn]).predict(seen[judged])

    return judge


def taxels_over_time(recorded):
    """[presses, BINS x taxels]: the mean change of each taxel since its first row in equal parts of the recording."""

    def of(counts):
        change = counts - counts[:1]
        change = np.sign(change) * np.log1p(np.abs(change) / SCALE)
        # A short press gives some of its rows to two parts.
        edges = np.linspace(0, len(change), BINS + 1)
        return [change[int(low) : max(int(high), int(low) + 1)].mean(axis=0) for low, high in zip(edges, edges[1:])]

    return np.array([np.concatenate(of(counts)) for counts in recorded.counts])


def guess(recorded, learn, judged):
    """The most frequent level."""
    levels, counts = np.unique(recorded.level[learn], return_counts=True)
    return np.full(len(judged), levels[counts.argmax()])


ALL = {
    "scikit-learn, taxels in 8 parts of time": by_regression(taxels_over_time),
    "control: the unloaded first row": by_regression(lambda recorded: np.array([counts[0] for counts in recorded.counts])),
    "control: the most frequent level": guess,
}


def balanced(level, said):
    return np.mean([np.mean(said[level == own] == own) for own in np.unique(level)])


def shown(level, said):
    """Balanced accuracy with its 95 % interval, by drawing the presses of each level anew."""
    rng = np.random.default_rng(SEED)
    places = [np.flatnonzero(level == own) for own in np.unique(level)]
    draws = [np.concatenate([rng.choice(of, len(of)) for of in places]) for _ in range(DRAWS)]
    low, high = np.percentile([balanced(level[of], said[of]) for of in draws], [2.5, 97.5])
    return f"{100 * balanced(level, said):5.1f} % ({100 * low:.1f} to {100 * high:.1f})"
