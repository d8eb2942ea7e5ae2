"""Shortest paths: against exact visibility graphs on random scenes; repaired fields against fresh searches."""

from __future__ import annotations

import copy
import itertools
import math

import networkx as nx
import numpy as np
import pytest
import shapely
from exploration_scenes import (
    FAMILIES,
    box,
    clear_points,
    free_space,
    lines_of,
    scene,
    shortest_lengths,
    tol_of,
    turned,
)

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.exploration import links
from polyexplore_gym.exploration.corners import CORNER, LEAF, TRAIL
from polyexplore_gym.exploration.path_graph import PathGraph
from polyexplore_gym.exploration.tolerances import squeezed

pytestmark = pytest.mark.bounds

RADIUS = 0.25
TOL = tol_of(SensorConfig(max_range=8.0), RADIUS)
ALL = np.array([-1e3, -1e3, 1e3, 1e3])
NO_PIECES, NO_OWNER = np.zeros((0, 4)), np.zeros(0, np.int64)


def graph_of(walls, tol=TOL, pieces=None, owner=None):
    """The graph over all of the walls at once."""
    graph = PathGraph(tol)
    graph.set_walls(walls, np.ones(len(walls), np.bool_), np.arange(len(walls)))
    pieces, owner = (NO_PIECES, NO_OWNER) if pieces is None else (pieces, owner)
    graph.set_pieces(pieces, np.zeros(len(pieces)), owner, ALL)
    graph.connect()
    return graph


def leaf(graph, x, y, owner):
    """One leaf."""
    return int(graph.add_leaves(np.array([[x, y]]), np.array([owner]))[0])


def fields(graph, points, owner=1000):
    """Leaves at the points, and the fields from all of them."""
    leaves = graph.add_leaves(points, owner + np.arange(len(points)))
    graph.connect()
    graph.set_sources(leaves)
    return leaves, np.array([graph.distances(leaf, leaves) for leaf in leaves])


def compare(family, seed, count=10):
    """Ours, the exact lengths for the radius and for 3 cm more, and the paths' smallest clearance."""
    walls = scene(family, seed)
    points = clear_points(np.random.default_rng([99, seed]), walls, RADIUS + 0.03, count)
    graph = graph_of(walls)
    leaves, ours = fields(graph, points)
    np.testing.assert_allclose(ours, ours.T, atol=1e-9)
    exact = shortest_lengths(free_space(walls, RADIUS), points)
    wider = shortest_lengths(free_space(walls, RADIUS + 0.03), points)
    lines, clearance = lines_of(walls), math.inf
    for i in range(count):
        for j in range(count):
            if i != j and np.isfinite(ours[i, j]):
                path = graph.path(int(leaves[i]), int(leaves[j]))
                np.testing.assert_allclose(path[[0, -1]], points[[j, i]])
                assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(ours[i, j])
                clearance = min(clearance, shapely.distance(lines, shapely.LineString(path)))
    upper = np.triu_indices(count, 1)
    return ours[upper], exact[upper], wider[upper], clearance


def study(family, seeds):
    """All pairs of many scenes: never too short, clear of the walls; the excess and the share of pairs lost."""
    excess, ratio, lost, lost_in = [], [], 0, []
    for seed in seeds:
        ours, exact, wider, clearance = compare(family, seed)
        assert clearance >= RADIUS + 0.002
        found = np.isfinite(ours)
        assert np.isfinite(exact[found]).all()
        assert (ours[found] >= exact[found] - 0.01).all()
        missing = np.isfinite(wider) & ~found
        lost += missing.sum()
        lost_in += [seed] * bool(missing.any())
        both = np.isfinite(wider) & found
        excess.append((ours - 1.06 * wider)[both])
        ratio.append((ours / np.maximum(wider, 1e-9))[both])
    return np.concatenate(excess), np.concatenate(ratio), lost, lost_in


RAGGED = pytest.mark.xfail(
    strict=False,
    reason="a corner's vertices that stand in for those of another wall end beside it, and short legs between two "
    "wall ends, fail the test of tautness: passages close",
)


@pytest.mark.parametrize(
    "family", [pytest.param(f, marks=RAGGED) if f == "ragged thick rooms" else f for f in FAMILIES]
)
def test_path_lengths_against_exact_ones(family):
    excess, ratio, lost, lost_in = study(family, range(14))
    assert lost == 0, f"no path where there is one, in scenes {lost_in}"
    assert ratio.mean() < 1.02
    assert excess.max() < 0.15


@pytest.mark.slow
@RAGGED
@pytest.mark.parametrize("family", FAMILIES)
def test_path_lengths_study(family):
    excess, ratio, lost, lost_in = study(family, range(1000, 1150))
    assert lost <= 0.002 * len(ratio), f"no path where there is one, in scenes {lost_in}"
    assert ratio.mean() < 1.02
    assert np.quantile(ratio, 0.99) < 1.06
    assert (excess > 0.15).mean() < 0.005


@pytest.mark.parametrize("width", [0.56, 0.6, 0.7, 0.9, 1.2])
@pytest.mark.parametrize("thickness", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8])
def test_every_door_that_is_wide_enough_is_passed(width, thickness, angle):
    """From either side, straight and aslant; a door as wide as the disc is not."""

    def room(width):
        walls = [box(-3, -2, 3, 2)]
        for a, b in ((-2, -width / 2), (width / 2, 2)):
            t = thickness / 2
            walls.append(box(-t, a, t, b) if thickness else np.array([[0.0, a, 0.0, b]]))
        w = np.vstack(walls)
        c, s = math.cos(angle), math.sin(angle)
        return (w.reshape(-1, 2) @ np.array([[c, s], [-s, c]])).reshape(-1, 4), np.array([[c, s], [-s, c]])

    walls, turn = room(width)
    points = np.array([[-2, 0.1], [-1, 1.6], [-0.6, -1.7], [2, 0.0], [0.6, 1.7], [1.5, -1.5]]) @ turn
    _, ours = fields(graph_of(walls), points)
    assert np.isfinite(ours).all()
    exact = shortest_lengths(free_space(walls, RADIUS, 16), points)
    assert (ours <= (1.04 if width > 0.58 else 1.12) * exact + 0.1).all()
    walls, turn = room(0.5)
    _, ours = fields(graph_of(walls), points)
    assert np.isinf(ours[:3, 3:]).all()


def wall_with_a_door(width, thickness, angle, radius):
    """Two halls of 12 radii, the wall between them with its door, and points on both sides; turned."""
    r, t = radius, 0.5 * thickness
    walls = [box(-12 * r, -8 * r, 12 * r, 8 * r)]
    for a, b in ((-8 * r, -width / 2), (width / 2, 8 * r)):
        walls.append(box(-t, a, t, b) if thickness else np.array([[0.0, a, 0.0, b]]))
    points = r * np.array([[-8, 0.4], [-4, 6.4], [-3.4, -6.7], [8, 0.0], [3.4, 6.7], [6, -6.0]])
    return turned(np.vstack(walls), angle), turned(np.tile(points, 2), angle)[:, :2]


@pytest.mark.parametrize("radius", [0.05, 0.25, 1.0])
@pytest.mark.parametrize("thickness", [0.0, 0.3, 1.2, 4.0])
def test_gates_little_wider_than_the_robot_are_passed(radius, thickness):
    """Doors of 2.04 to 2.4 radii, walls of any thickness (in radii) at any angle; one of 2.01 radii is not passed."""
    rng = np.random.default_rng([5, int(100 * radius), int(10 * thickness)])
    tol = tol_of(SensorConfig(max_range=32.0 * radius, sigma_range=0.0, sigma_angle=0.0), radius)
    for width in (*np.arange(2.04, 2.4, 0.03), 2.4):
        for angle in (0.0, rng.uniform(0.0, math.pi)):
            walls, points = wall_with_a_door(width * radius, thickness * radius, angle, radius)
            graph = graph_of(walls, tol)
            leaves, ours = fields(graph, points)
            assert np.isfinite(ours).all(), (width, angle)
            lines = lines_of(walls)
            for i, j in itertools.product(range(3), range(3, 6)):
                way = shapely.LineString(graph.path(int(leaves[i]), int(leaves[j])))
                assert lines.distance(way) >= radius
            if angle == 0.0:
                exact = shortest_lengths(free_space(walls, radius, 16), points)
                assert (ours <= 1.12 * exact + 0.4 * radius).all()
    walls, points = wall_with_a_door(2.01 * radius, thickness * radius, 0.7, radius)
    assert np.isinf(fields(graph_of(walls, tol), points)[1][:3, 3:]).all()


def test_squeezed_paths_lead_through_what_the_noise_has_closed():
    tol = tol_of(SensorConfig(sigma_range=0.01), RADIUS)
    less = squeezed(tol)
    assert tol.need - less.need == pytest.approx(0.03)
    assert tol.sweep - less.sweep == pytest.approx(0.03)
    assert less._replace(need=tol.need, sweep=tol.sweep) == tol  # nothing else changes
    assert tol.need - squeezed(tol._replace(sigma_range=1.0)).need == pytest.approx(0.15 * RADIUS)
    # A doorway of 2.08 radii, of which the map has taken 2 cm on each side.
    walls, points = wall_with_a_door(2.08 * RADIUS - 0.04, 0.1, 0.4, RADIUS)
    assert np.isinf(fields(graph_of(walls, tol), points)[1][:3, 3:]).all()
    assert np.isfinite(fields(graph_of(walls, less), points)[1]).all()


# Open edges ---------------------------------------------------------------------------------------


def islands(rng, count):
    """The unknown in the middle of the known: (its area, its boundary as directed open edges (m, 4))."""
    parts = []
    for _ in range(count):
        n = int(rng.integers(3, 7))
        t = np.sort(rng.uniform(0.0, 2.0 * math.pi, n))
        corners = rng.uniform(0.3, 1.4, (n, 1)) * np.stack((np.cos(t), np.sin(t)), axis=1)
        parts.append(shapely.Polygon(corners + rng.uniform(-4.0, 4.0, 2)).buffer(0))
    area = shapely.union_all(parts).buffer(-0.02).buffer(0.02, join_style="mitre").simplify(0.02)
    edges = []
    for part in shapely.get_parts(area):
        for r in (part.exterior, *part.interiors):
            p = shapely.get_coordinates(r)
            if shapely.is_ccw(r) == (r is part.exterior or r.equals(part.exterior)):
                p = p[::-1]  # the unknown on the right
            for a, b in itertools.pairwise(p):
                cuts = np.linspace(a, b, max(math.ceil(math.dist(a, b) / 0.8), 1) + 1)
                edges += np.hstack([cuts[:-1], cuts[1:]]).tolist()
    return area, np.array(edges)


@pytest.mark.parametrize("family", ["strewn", "furnished", "rooms"])
def test_paths_round_the_unknown_are_shortest_paths(family):
    """They turn at bends of the open edges, from which nothing has to be kept."""
    rng = np.random.default_rng([6, len(family)])
    ratio, excess, round_about = [], [], 0
    for seed in range(12):
        walls = scene(family, seed)
        unknown, pieces = islands(rng, int(rng.integers(2, 6)))
        points = clear_points(rng, walls, RADIUS + 0.03, 60)
        points = points[shapely.distance(unknown, shapely.points(points)) > TOL.slack + 0.01][:11]
        graph = graph_of(walls, pieces=pieces, owner=np.zeros(len(pieces), np.int64))
        leaves, ours = fields(graph, points)
        free = free_space(walls, RADIUS)
        exact = shortest_lengths(free.difference(unknown), points)
        wider = shortest_lengths(
            free_space(walls, RADIUS + 0.03).difference(unknown.buffer(0.03, join_style="mitre")), points
        )
        inner = unknown.buffer(-1e-6)
        for i, j in itertools.combinations(range(len(points)), 2):
            if np.isfinite(ours[i, j]):
                way = shapely.LineString(graph.path(int(leaves[i]), int(leaves[j])))
                assert not way.intersects(inner)
                assert ours[i, j] >= exact[i, j] - 0.01
            assert np.isfinite(ours[i, j]) or np.isinf(wider[i, j]), (seed, i, j)
            if np.isfinite(wider[i, j]):
                ratio.append(ours[i, j] / wider[i, j])
                excess.append(ours[i, j] - 1.06 * wider[i, j])
        round_about += (exact > shortest_lengths(free, points) + 0.05)[np.isfinite(exact)].sum()
    assert round_about > 100
    assert np.mean(ratio) < 1.02
    # A bend that stands too near to a wall has no vertex: very few paths go another way.
    assert np.mean(np.array(excess) > 0.15) < 0.01


def test_open_edges_block_until_they_are_gone_and_never_their_owner():
    walls = box(-3, -2, 3, 2)
    pieces = np.array([[0.0, -2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0]])
    graph = graph_of(walls, pieces=pieces, owner=np.array([7, 7]))
    points = np.array([[-2.0, 0.5], [2.0, 0.5], [2.0, -0.5]])
    leaves, ours = fields(graph, points)
    assert np.isinf(ours[0, 1:]).all()
    assert ours[1, 2] == pytest.approx(1.0)
    node = leaf(graph, 0.0, 0.0, 7)  # stands on its own edge
    beyond = leaf(graph, 2.0, 1.0, 7)  # may look through its own edge
    graph.connect()
    graph.repair()
    lengths = graph.distances(leaves[0], np.array([node, beyond]))
    np.testing.assert_allclose(lengths, [math.hypot(2, 0.5), math.hypot(4, 0.5)])
    graph.remove_leaves(np.array([beyond]))
    graph.set_pieces(NO_PIECES, np.zeros(0), NO_OWNER, ALL)
    graph.repair()
    assert graph.distances(leaves[0], leaves[1:2]) == pytest.approx(4.0)


# Repair -------------------------------------------------------------------------------------------


def edges(graph):
    """The open edges (e, 2)."""
    living = np.flatnonzero(graph.vertices.kind[: graph.n_vertices] >= 0).tolist()
    pairs = [(u, int(v)) for u in living for v in graph.neighbours(u)]
    assert len(set(pairs)) == len(pairs)
    assert {(v, u) for u, v in pairs} == set(pairs), "an edge is known at one of its ends only"
    return np.array([(u, v) for u, v in pairs if u < v], np.int64).reshape(-1, 2)


def exported(graph):
    """The living graph as networkx, leaves as dead ends seen from everywhere but themselves."""
    out = nx.Graph()
    out.add_nodes_from(np.flatnonzero(graph.vertices.kind[: graph.n_vertices] >= 0).tolist())
    for u, v in edges(graph).tolist():
        first = graph.links.first[u]
        length = float(graph.links.cost[first : first + graph.links.degree[u]][graph.neighbours(u) == v][0])
        assert length == pytest.approx(math.dist(graph.vertices.position[u], graph.vertices.position[v]))
        out.add_edge(u, v, weight=length)
    return out


def check_fields(graph):
    network = exported(graph)
    leaves = {v for v in network if graph.vertices.kind[v] == LEAF}
    for source in graph.source_of[graph.source_of >= 0].tolist():
        reach = graph.reach[graph.row_of[source]]
        through = network.subgraph([v for v in network if v not in leaves or v == source])
        lengths = nx.single_source_dijkstra_path_length(through, source)
        for v in network:
            wanted = lengths.get(v, math.inf)
            if v in leaves and v != source:
                wanted = min(
                    (
                        lengths.get(w, math.inf) + d["weight"]
                        for w, d in network[v].items()
                        if w not in leaves or w == source
                    ),
                    default=math.inf,
                )
            found = graph.distances(source, np.array([v]))[0]
            if wanted > reach:
                assert found >= wanted - 1e-9
                continue
            assert found == pytest.approx(wanted, abs=1e-9)
            if np.isfinite(wanted):
                path = graph.path(source, v)
                assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(wanted, abs=1e-9)


def check_between(graph, vertices, guess):
    """Lengths between leaves, of fields that reach only as far as they must, against whole fields."""
    again = copy.deepcopy(graph)
    again.source_of[:] = again.row_of[:] = -1
    again.set_sources(vertices)
    whole = np.array([again.distances(v, vertices) for v in vertices])
    np.testing.assert_allclose(graph.between(vertices, guess, int(vertices[0])), whole, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_fields_stay_right_through_any_sequence_of_changes(seed):
    rng = np.random.default_rng(seed)
    rows = np.vstack([scene("strewn", seed), scene("rooms", seed + 50)[4:], scene("furnished", seed)[4:]])
    rng.shuffle(rows[4:])
    alive = np.zeros(len(rows), np.bool_)
    alive[: int(rng.integers(4, 12))] = True
    graph = PathGraph(TOL)
    touched = np.flatnonzero(alive)
    pieces, owner = NO_PIECES, NO_OWNER
    leaves: list[int] = []
    checked = 0
    for _ in range(25):
        graph.set_walls(rows.copy(), alive.copy(), touched)
        x, y = rng.uniform(-4, 4, 2)
        graph.set_pieces(
            pieces, np.zeros(len(pieces)), owner, ALL if rng.random() < 0.5 else np.array([x - 3, y - 3, x + 3, y + 3])
        )
        graph.add_way_point(x, y)
        if rng.random() < 0.3:
            graph.add_felt(np.array([x, y, x + 0.02, y]))
        for _ in range(int(rng.integers(0, 5))):
            if leaves and rng.random() < 0.4:
                v = leaves.pop(int(rng.integers(len(leaves))))
                graph.remove_leaves(np.array([v]))
            else:
                x, y = rng.uniform(-5, 5, 2)
                leaves.append(leaf(graph, x, y, int(rng.integers(0, 5))))
        graph.connect()
        if rng.random() < 0.7:
            graph.set_sources(np.array([v for v in leaves if rng.random() < 0.3], np.int64))
        if len(leaves) > 1 and rng.random() < 0.7:
            some = rng.choice(leaves, int(rng.integers(1, len(leaves))), replace=False)
            check_between(graph, some, rng.choice([0.5, 2.0, 8.0, math.inf], len(some)))
        if rng.random() < 0.7:
            graph.repair()
            check_fields(graph)
            checked += (graph.source_of >= 0).sum()
            if rng.random() < 0.7:
                graph.recycle()
                check_fields(graph)
        # Walls come, go and shift; open edges come and go.
        changes = rng.choice(len(rows), int(rng.integers(0, 5)), replace=False)
        alive[changes] = rng.random(len(changes)) < 0.6
        touched = changes
        shifted = changes[rng.random(len(changes)) < 0.5]
        rows[shifted] += rng.normal(0, 0.02, (len(shifted), 4))
        m = int(rng.integers(0, 6))
        start = rng.uniform(-5, 5, (m, 2))
        pieces = np.hstack([start, start + rng.normal(0, 1, (m, 2))])
        owner = rng.integers(0, 5, m)
    assert checked > 10


def test_a_trail_laid_again_is_the_same_trail_and_leads_back():
    # The robot came through a gap that the map has closed since.
    room = box(-2.0, -2.0, 2.0, 2.0)
    graph = graph_of(room)
    way = np.stack((np.arange(0.0, 4.0, 0.3), np.zeros(14)), axis=1)
    robot = leaf(graph, *way[-1], owner=-2)
    home = leaf(graph, *way[0], owner=7)
    graph.connect()
    graph.set_sources(np.array([robot]))
    assert np.isinf(graph.distances(robot, np.array([home])))
    graph.add_trail(way, robot)
    graph.connect()
    graph.set_sources(np.array([robot]))
    assert np.isfinite(graph.distances(robot, np.array([home]))).all()

    graph.remove_leaves(np.array([robot]))
    longer = np.vstack((way, [[4.2, 0.0], [4.5, 0.0]]))
    robot = leaf(graph, *longer[-1], owner=-2)
    graph.connect()
    graph.add_trail(longer, robot)
    graph.connect()
    graph.set_sources(np.array([robot]))
    assert np.isfinite(graph.distances(robot, np.array([home]))).all()
    laid = graph.vertices.position[(graph.vertices.kind == CORNER) & (graph.vertices.shape.limit == TRAIL)]
    assert len(laid) > 2
    assert len(np.unique(laid, axis=0)) == len(laid)


def test_a_robot_on_a_trail_that_was_laid_goes_on_to_both_sides():
    """In a passage that the map closes it went back first, and then forward again: decision by decision, for ever."""
    side = TOL.sweep - 0.02
    graph = graph_of(np.vstack((box(-3.0, -2.0, 6.0, 2.0), [[0.0, side, 3.0, side], [0.0, -side, 3.0, -side]])))
    way = np.stack((np.linspace(-1.5, 4.5, 21), np.zeros(21)), axis=1)
    robot = leaf(graph, *way[-1], owner=-2)
    nodes = [leaf(graph, *way[0], owner=7), leaf(graph, *way[-1], owner=8)]
    graph.connect()
    graph.add_trail(way, robot)
    graph.remove_leaves(np.array([robot]))
    assert not len(graph.trail_at(1.4, 0.5))
    robot = leaf(graph, 1.4, 0.0, owner=-2)
    graph.join_trail(robot, graph.trail_at(1.4, 0.0))
    graph.set_sources(np.array([robot]))
    assert graph.distances(robot, np.array(nodes)) == pytest.approx([2.9, 3.1], abs=0.1)


def test_edges_in_the_graph_keep_clear_of_walls_that_came_later():
    """Every open edge keeps its clearance to all living walls, whatever came and went."""
    rng = np.random.default_rng(5)
    rows = np.vstack([box(-5, -5, 5, 5), scene("rooms", 60)[4:], scene("furnished", 1)[4:]])
    rows[4:] = rows[4:][rng.permutation(len(rows) - 4)]
    alive = np.zeros(len(rows), np.bool_)
    graph = PathGraph(TOL)
    for i in range(0, len(rows), 4):
        fresh = np.arange(i, min(i + 4, len(rows)))
        alive[fresh] = True
        graph.set_walls(rows, alive, fresh)
        graph.connect()
        ends = np.concatenate((edges(graph), graph.blocked))
        ways = shapely.linestrings(
            np.stack((graph.vertices.position[ends[:, 0]], graph.vertices.position[ends[:, 1]]), axis=1)
        )
        assert (shapely.distance(lines_of(rows[alive]), ways) > RADIUS).all()
        corners = graph.vertices.position[: graph.n_vertices][graph.vertices.kind[: graph.n_vertices] == CORNER]
        clearance = shapely.distance(lines_of(rows[alive]), shapely.points(corners))
        assert (clearance >= TOL.sweep - 1e-9).all()


def test_retreat_leads_away_from_the_wall_that_was_touched():
    rng = np.random.default_rng(8)
    found = 0
    for seed in range(60):
        walls = scene("furnished", seed)
        lines = lines_of(walls)
        graph = graph_of(walls)
        for x, y in clear_points(rng, walls, RADIUS - 0.02, 20):
            near = lines.distance(shapely.Point(x, y))
            rx, ry, ok = graph.retreat(x, y)
            if near >= TOL.need:
                assert (rx, ry, ok) == (x, y, True)
            elif ok:
                found += 1
                assert lines.distance(shapely.Point(rx, ry)) >= TOL.need - 1e-9
                assert lines.distance(shapely.LineString([(x, y), (rx, ry)])) >= near - 1e-5
    assert found > 20


def test_what_blocked_a_leg_is_tried_first_and_comes_forward():
    rng = np.random.default_rng(6)
    found = 0
    for _ in range(300):
        walls, leg = rng.uniform(-3.0, 3.0, (6, 4)), rng.uniform(-3.0, 3.0, 4)
        crossed = shapely.crosses(shapely.linestrings(walls.reshape(-1, 2, 2)), shapely.linestrings(leg.reshape(2, 2)))
        order = walls.copy()
        got = links._crosses_one(leg[0], leg[1], leg[2] - leg[0], leg[3] - leg[1], order, len(order))
        assert got == crossed.any()
        k = int(crossed.argmax())
        wanted = list(range(6))
        if got and k:
            wanted[k - 1], wanted[k] = k, k - 1
        np.testing.assert_array_equal(order, walls[wanted])
        found += got
    assert 50 < found < 250
