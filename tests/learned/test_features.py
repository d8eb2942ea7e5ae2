import math

import numpy as np
import pytest
from observations import moved, observation, permuted

from baselines.learned.features import NODE, PAIR, SCALARS, VECTORS, WHOLE, features
from baselines.pockets import RAYS, rays

RAY = len(SCALARS) + 2 * len(VECTORS)


def test_shapes_and_slots():
    seen = observation()
    found = features(seen)
    k = int(seen["action_mask"].sum())
    assert found.node.shape == (k, NODE)
    assert found.pair.shape == (k, k, PAIR)
    assert found.whole.shape == (WHOLE,)
    np.testing.assert_array_equal(found.slots, np.flatnonzero(seen["action_mask"]))
    for part in (found.node, found.pair, found.whole):
        assert part.dtype == np.float32
        assert np.isfinite(part).all()
        assert np.abs(part).max() < 20.0


def test_the_frame_of_the_map_does_not_matter():
    seen = observation()
    found = features(seen)
    other = features(moved(seen, 2.0, (30.0, -7.0), mirror=False))
    for name in ("node", "pair", "whole"):
        if name != "whole":  # its last number is the extent along the axes of the map
            np.testing.assert_allclose(getattr(found, name), getattr(other, name), atol=2e-3)


def test_order_of_slots_and_padding_do_not_matter():
    seen = observation()
    order = np.random.default_rng(0).permutation(len(seen["action_mask"]))
    found, other = features(seen), features(permuted(seen, order))
    row = {int(slot): i for i, slot in enumerate(found.slots)}
    same = [row[int(order[slot])] for slot in other.slots]
    # Ties of rank and of near-equal tours may fall otherwise.
    np.testing.assert_allclose(other.node, found.node[same], atol=0.2)
    np.testing.assert_allclose(other.pair, found.pair[same][:, same], atol=1e-6)


def test_rays_by_hand():
    # An edge from (0, 0) to (2, 0), looked at from below; a wall 3 m above it and another edge to the right.
    edges = np.array([[0.0, 0.0, 2.0, 0.0], [3.0, 0.2, 3.0, 4.0]])
    heading = np.array([math.pi / 2, math.pi])
    lines = np.array([[-50.0, 3.0, 2.9, 3.0]])
    length, ends_on = rays(edges, heading, lines, 3, 0.0, 10.0)
    # Directions -60, 0 and 60 degrees from the normal: to the right, up, to the left.
    np.testing.assert_allclose(length[0], [2.0 / math.sin(math.pi / 3), 3.0, 6.0])
    assert ends_on[0].tolist() == [1, -1, -1]
    assert (length[1] <= 10.0).all()
    empty, nothing = rays(edges[:1], heading[:1], np.zeros((0, 4)), RAYS, 0.0, 16.0)
    assert (empty == 16.0).all()
    assert (nothing == -2).all()


def test_nothing_to_choose_and_missing_path_lengths_are_errors():
    seen = observation()
    with pytest.raises(ValueError, match="episode is over"):
        features({**seen, "action_mask": np.zeros_like(seen["action_mask"])})
    with pytest.raises(ValueError, match="pairwise = True"):
        features({**seen, "path_lengths": np.zeros_like(seen["path_lengths"])})
