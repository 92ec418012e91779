"""Comparison of inferred tensions with those of a foam."""

import numpy as np


def against_truth(inferred, foam):
    """True and inferred tensions where determined, and standard deviations, each relative to its mean.

    Labels of cells are the numbers of the true cells, from 1.
    """
    tension = foam[1]
    number = np.append(inferred.labels, 0)
    pairs = np.sort(number[np.asarray(inferred.tissue.topology.edge_cells)], axis=1)
    true = true_pairs(foam)
    edge = np.array([true.index(pair) if pair in true else -1 for pair in pairs.tolist()])
    use = inferred.determined & (edge >= 0)
    expected = tension[edge[use]]
    return expected / expected.mean(), inferred.tensions[use], inferred.tension_deviations[use]


def true_pairs(foam):
    """The labels on both sides of each edge of a foam, ascending; 0 is the exterior."""
    tissue = foam[0]
    true = np.append(np.arange(1, tissue.n_cells + 1), 0)
    return np.sort(true[np.asarray(tissue.topology.edge_cells)], axis=1).tolist()


def invented(inferred, foam):
    """Pairs of labels with a determined tension that do not touch in the foam."""
    pairs = np.append(inferred.labels, 0)[np.asarray(inferred.tissue.topology.edge_cells)]
    true = true_pairs(foam)
    return [p for p in np.sort(pairs, axis=1)[inferred.determined].tolist() if p not in true]
