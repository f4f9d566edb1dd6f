"""Groups of like pixels: found, all the same on every run, and unmoved by rounding."""

import numpy as np
import pytest

from invrender.refine.groups import group


def clusters(n=300):
    rng = np.random.default_rng(2)
    means = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [1, 1.5, 2]])
    true = np.arange(n) % 4
    return means[true] + 0.05 * rng.standard_normal((n, 3)), true, means


def test_clusters_are_found():
    points, true, means = clusters()
    centres, label = group(points, 4)
    for k in range(4):
        found = np.unique(label[true == k])
        assert len(found) == 1
        np.testing.assert_allclose(centres[found[0]], means[k], atol=0.02)


def test_centres_are_means_and_each_point_has_the_nearest():
    points = np.random.default_rng(3).uniform(size=(500, 4))
    centres, label = group(points, 6)
    assert centres.shape == (6, 4)
    for k in range(6):
        np.testing.assert_allclose(centres[k], points[label == k].mean(0))
    apart = np.linalg.norm(points[:, None] - centres, axis=-1)
    assert (apart.argmin(1) == label).mean() > 0.98


def test_rounding_changes_no_group():
    points, _, _ = clusters()
    first = group(points, 4)[1]
    again = group(points.astype(np.float32), 4)[1]
    assert np.array_equal(first, again)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_fewer_points_than_groups(n):
    points = np.arange(n)[:, None] * np.ones(2)
    centres, label = group(points, 5)
    assert len(centres) == n and sorted(label) == list(range(n))


def test_points_all_alike_are_one_group():
    centres, label = group(np.full((20, 3), 0.4), 4)
    assert len(centres) == 1 and (label == 0).all()
